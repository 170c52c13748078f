"""Where a result comes from: stages are merged, contradictions refused, differences said in words."""

import copy
import hashlib
import json

import pytest

from drivesplat.errors import ResultError
from drivesplat.provenance.record import combine, differences, digests_of, provenance


def extract(settings=None, code="e1", tables="t1") -> dict:
    return provenance("extract", settings or {"scene": "0061", "sweeps": False}, code, [], {"tables": tables})


def masks(upstream: dict, code="m1") -> dict:
    return provenance("masks", {"masks": {"sky_folder": None}}, code, [upstream], {})


def seed(upstream: dict) -> dict:
    return provenance("lidar_seed", {"random_seed": 0}, "s1", [upstream], {"points_file": "p1"})


def sha256(value) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def test_a_result_carries_its_own_stage_and_all_before_it():
    scene = extract()
    record = provenance("parser", {"images": {"width": 640}}, "p", [scene, seed(scene), masks(scene)], {})
    assert record["stages"] == {
        "extract": {"settings": {"scene": "0061", "sweeps": False}, "code": "e1"},
        "lidar_seed": {"settings": {"random_seed": 0}, "code": "s1"},
        "masks": {"settings": {"masks": {"sky_folder": None}}, "code": "m1"},
        "parser": {"settings": {"images": {"width": 640}}, "code": "p"},
    }
    assert record["inputs"] == {"tables": "t1", "points_file": "p1"}


def test_the_digests_that_metrics_json_promises_are_those_of_what_stands_beside_them():
    record = masks(extract())
    assert record["settings_sha256"] == sha256({name: stage["settings"] for name, stage in record["stages"].items()})
    assert record["code_sha256"] == sha256({name: stage["code"] for name, stage in record["stages"].items()})
    assert record["inputs_sha256"] == sha256(record["inputs"])
    assert {"torch", "gsplat"} <= record["versions"].keys()


@pytest.mark.parametrize(
    ("other", "altered"),
    [
        ({}, set()),
        ({"settings": {"sweeps": False, "scene": "0061"}}, set()),
        ({"settings": {"scene": "0061", "sweeps": True}}, {"settings_sha256"}),
        ({"code": "e2"}, {"code_sha256"}),
        ({"tables": "t2"}, {"inputs_sha256"}),
    ],
)
def test_each_digest_answers_for_its_own_part(other, altered):
    a, b = masks(extract()), masks(extract(**other))
    digests = {"settings_sha256", "code_sha256", "inputs_sha256"}
    assert {name for name in digests if a[name] != b[name]} == altered


def test_the_order_of_what_a_result_is_made_from_does_not_matter():
    scene = extract()
    assert combine([seed(scene), masks(scene)]) == combine([masks(scene), seed(scene)])


def test_results_made_otherwise_are_refused_naming_stage_and_setting_or_input():
    other = extract({"scene": "0061", "sweeps": True})
    with pytest.raises(ResultError) as failure:
        provenance("parser", {}, "p", [masks(extract()), seed(other)], {})
    assert all(word in str(failure.value) for word in ("extract", "sweeps", "True", "False"))
    assert "masks" not in str(failure.value)
    for other, words in ((extract(code="e2"), "extract: other code"), (extract(tables="t2"), "tables")):
        with pytest.raises(ResultError, match=words):
            combine([masks(extract()), seed(other)])


def stage(code="c", **settings) -> dict:
    return {"settings": settings, "code": code}


@pytest.mark.parametrize(
    ("expected", "found", "words"),
    [
        ({"train": {"iterations": 30000}}, {"train": {"iterations": 7000}}, ["train.iterations", "30000", "7000"]),
        ({"train": {"mcmc": {"lr": 5.0}}}, {"train": {"mcmc": {"lr": 7.5}}}, ["train.mcmc.lr", "7.5"]),
        ({"cameras": ["A", "B"]}, {"cameras": ["A"]}, ["cameras", "['A', 'B']", "['A']"]),
        ({"width": None}, {"width": 640}, ["width", "None", "640"]),
        ({"sky": "mask"}, {"sky": "none"}, ["sky", "'mask'", "'none'"]),
        ({"new": 1, "same": 2}, {"same": 2}, ["new", "1"]),
        ({"same": 2}, {"old": 1, "same": 2}, ["old", "1"]),
        ({"polygons": {}}, {"polygons": {"CAM_FRONT": [[0, 1]]}}, ["polygons.CAM_FRONT", "[[0, 1]]"]),
    ],
)
def test_a_difference_names_stage_setting_and_both_values(expected, found, words):
    (line,) = differences({"extract": stage(x=1), "a": stage(**expected)}, {"extract": stage(x=1), "a": stage(**found)})
    assert line.startswith("a: ")
    assert all(word in line for word in words), line


def test_only_what_differs_is_said_and_on_which_side():
    stages = {"train": stage(train={"iterations": 7000, "mcmc": {"noise_lr": 5e5}}, sky="none")}
    assert differences(stages, copy.deepcopy(stages)) == []
    (line,) = differences({"a": stage(width=320)}, {"a": stage(width=640)})
    assert line.index("640") < line.index("in the result") < line.index("320") < line.index("now")
    assert differences({"a": stage(), "c": stage()}, {"a": stage(), "d": stage()}, shared_only=True) == []


def test_digests_of_files_depend_on_names_and_contents_but_not_on_order_or_folder(tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        for name in ("a.json", "b.json"):
            (tmp_path / folder / name).write_text(name)
    one = [tmp_path / "one" / name for name in ("a.json", "b.json")]
    two = [tmp_path / "two" / name for name in ("b.json", "a.json")]
    before = digests_of(one)
    assert digests_of(two) == before
    (tmp_path / "two" / "a.json").write_text("other")
    assert digests_of(two) != before
    one[0].rename(tmp_path / "one" / "c.json")
    assert digests_of([tmp_path / "one" / "c.json", one[1]]) != before
