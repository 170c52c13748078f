"""File digests: what was altered after its rule wrote it is refused by name; what cannot be known is accepted."""

import hashlib
import json
import logging
from pathlib import Path

import pytest

from drivesplat.errors import ResultError
from drivesplat.provenance.file_digests import check_dataset, checked_digest, file_digest, member_states, record_output


@pytest.fixture
def seed(tmp_path) -> Path:
    """A recorded output without members."""
    path = tmp_path / "0001/seed.ply"
    path.parent.mkdir()
    path.write_bytes(b"points")
    record_output(path, "lidar_seed", {}, {"results/0001/scene.json": "12"})
    return path


@pytest.fixture
def masks(tmp_path) -> Path:
    """A recorded output with two members, and a file of an earlier run beside them."""
    path = tmp_path / "0001/masks/masks.json"
    for name in ("old", "1", "2"):
        (path.parent / f"sky/CAM/{name}.png").parent.mkdir(parents=True, exist_ok=True)
        if name == "1":
            before = member_states(path)
        (path.parent / f"sky/CAM/{name}.png").write_text(name)
    path.write_text("{}")
    record_output(path, "masks", before, {})
    return path


def test_the_record_holds_what_was_read_and_written(seed):
    record = json.loads((seed.parent / ".digests/seed.ply.json").read_text())
    assert record["rule"] == "lidar_seed" and record["read"] == {"results/0001/scene.json": "12"}
    assert record["digest"] == file_digest(seed) == checked_digest(seed) and record["members"] == {}
    assert file_digest(seed) == hashlib.blake2b(b"points", digest_size=16).hexdigest()


def test_an_altered_output_is_refused_with_the_rule_that_rebuilds_it(seed):
    seed.write_bytes(b"pointz")
    with pytest.raises(ResultError) as error:
        checked_digest(seed)
    assert str(error.value) == (
        f"{seed}: its content is not what the rule wrote; delete it and rerun: the rule 'lidar_seed' rebuilds it"
    )


@pytest.mark.parametrize(("change", "why"), [("altered", "not what the rule wrote"), ("gone", "missing")])
def test_an_altered_or_missing_member_is_refused_with_the_file_to_delete(masks, change, why):
    member = masks.parent / "sky/CAM/2.png"
    member.write_text("3") if change == "altered" else member.unlink()
    with pytest.raises(ResultError) as error:
        checked_digest(masks)
    message = str(error.value)
    assert message.startswith(f"{member}: ") and why in message
    assert message.endswith(f"; delete {masks} and rerun: the rule 'masks' rebuilds it")


def test_files_that_a_rule_found_beside_its_output_are_not_its_members(masks):
    (masks.parent / "sky/CAM/old.png").unlink()
    assert checked_digest(masks) == file_digest(masks)


def test_a_file_without_a_record_is_accepted_with_a_warning(seed, caplog):
    (seed.parent / ".digests/seed.ply.json").unlink()
    with caplog.at_level(logging.WARNING):
        assert checked_digest(seed) == file_digest(seed)
    assert [str(seed) in record.getMessage() for record in caplog.records] == [True]


@pytest.mark.parametrize("content", ["", "{", "[]", '{"rule": "x", "digest": "", "members": [], "read": {}}', "\x00"])
def test_a_damaged_record_is_refused_with_what_to_delete(seed, content):
    (seed.parent / ".digests/seed.ply.json").write_text(content)
    with pytest.raises(ResultError) as error:
        checked_digest(seed)
    assert f"delete {seed} and rerun" in str(error.value)


@pytest.fixture
def dataset(tmp_path) -> dict[str, Path]:
    """An image and a sweep that `extract` read for the scene in 0001/."""
    files = {"images": tmp_path / "a.jpg", "sweeps": tmp_path / "a.bin"}
    for path in files.values():
        path.write_text("recorded")
    scene = tmp_path / "0001/scene.json"
    scene.parent.mkdir()
    scene.write_text("{}")
    record_output(scene, "extract", {}, {}, {kind: {str(p): file_digest(p)} for kind, p in files.items()})
    return files


@pytest.mark.parametrize("kind", ["images", "sweeps"])
def test_a_dataset_file_replaced_after_extract_is_refused_by_the_stages_that_read_its_kind(dataset, tmp_path, kind):
    check_dataset(tmp_path / "0001", dataset)
    dataset[kind].write_text("replaced")
    with pytest.raises(ResultError) as error:
        check_dataset(tmp_path / "0001", [kind])
    message = str(error.value)
    assert message.startswith(f"{dataset[kind]}: changed since") and "the rule 'extract'" in message
    assert f"delete {tmp_path / '0001/scene.json'} and rerun" in message
    check_dataset(tmp_path / "0001", dataset.keys() - {kind})


def test_a_missing_dataset_file_is_left_to_its_reader_and_a_scene_without_record_is_accepted(dataset, tmp_path):
    dataset["images"].unlink()
    check_dataset(tmp_path / "0001", dataset)
    check_dataset(tmp_path / "0002", dataset)
