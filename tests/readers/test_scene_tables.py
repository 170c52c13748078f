"""The rows of a scene from nuScenes' tables: complete, without rows of other scenes, in bounded memory."""

import json
import os
import tracemalloc
from pathlib import Path

import pytest
from helpers import drives
from helpers.drives import World, write_world
from helpers.table_files import copy_of, edit, row

from drivesplat.errors import DatasetError
from drivesplat.preprocess.extract import extract_scene
from drivesplat.readers.nuscenes import scene_tables
from drivesplat.readers.nuscenes.scene_tables import index_tables, read_scene_tables, rows, scene_file

pytestmark = pytest.mark.usefixtures("uncompared")

VERSION, SCENES = "v1.0-mini", ("0001", "0002", "0003")


@pytest.fixture(scope="module")
def three_scenes(tmp_path_factory) -> Path:
    """A tiny dataset of three scenes, read only."""
    return write_world(tmp_path_factory.mktemp("three"), World(scenes=SCENES, key_frames=5, width=48, height=27))


@pytest.fixture
def root(three_scenes, tmp_path) -> Path:
    """A copy of it that a test may change."""
    return copy_of(three_scenes, tmp_path / "nuscenes")


def expected_tokens(root: Path, scene: str) -> dict[str, set[str]]:
    """The tokens of all rows but those of other scenes, which contain the name of theirs."""
    others = [name for name in SCENES if name != scene]
    return {
        path.stem: {row["token"] for row in json.loads(path.read_text()) if not any(n in row["token"] for n in others)}
        for path in (root / VERSION).glob("*.json")
    }


@pytest.mark.parametrize("buffer", [500, 2**26])
def test_a_scenes_file_has_exactly_the_rows_of_the_scene(root, tmp_path, buffer, monkeypatch):
    monkeypatch.setattr(scene_tables, "_BUFFER", buffer)
    index_tables(root, VERSION, SCENES, tmp_path / "rows")
    for scene in SCENES:
        found, expected = read_scene_tables(scene_file(tmp_path / "rows", scene)), expected_tokens(root, scene)
        assert {"sample", "sample_data", "sample_annotation", "ego_pose", "map"} <= set(found) <= set(expected)
        for table, of in found.items():
            assert len(of) == len(expected[table]) and {row["token"] for row in of} == expected[table], table


def test_a_scene_read_from_its_rows_equals_the_one_read_from_the_tables(root, tmp_path):
    index_tables(root, VERSION, SCENES, tmp_path)
    for name in SCENES:
        source = drives.source(scene=name, lidar_sweeps=True)
        assert repr(extract_scene(source, root, scene_file(tmp_path, name))) == repr(extract_scene(source, root))


def times_of_change(folder: Path) -> dict[str, int]:
    return {scene: scene_file(folder, scene).stat().st_ino for scene in SCENES}


def test_unchanged_tables_are_not_read_again_and_touched_ones_rewrite_no_scene(root, tmp_path, monkeypatch):
    index_tables(root, VERSION, SCENES, tmp_path)
    before = times_of_change(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(scene_tables, "rows", lambda table: pytest.fail(f"{table} is read"))
        index_tables(root, VERSION, SCENES, tmp_path)
    for table in (root / VERSION).iterdir():
        os.utime(table, (2e9, 2e9))
    index_tables(root, VERSION, SCENES, tmp_path)
    assert times_of_change(tmp_path) == before


@pytest.mark.parametrize(
    ("table", "token", "changes"),
    [
        ("sample_annotation", "0002 annotation 0 4", {"size": [1.0, 2.0, 3.0]}),
        ("ego_pose", "0002 CAM_FRONT 2", {"translation": [1.0, 2.0, 3.0]}),
        ("sample", "0002 sample 3", {"timestamp": 7}),
    ],
)
def test_a_changed_row_rewrites_its_own_scene_only(root, tmp_path, table, token, changes):
    index_tables(root, VERSION, SCENES, tmp_path)
    before = times_of_change(tmp_path)
    edit(root, table, lambda rows: row(rows, token).update(changes))
    index_tables(root, VERSION, SCENES, tmp_path)
    after = times_of_change(tmp_path)
    assert [scene for scene in SCENES if after[scene] != before[scene]] == ["0002"]
    changed = row(read_scene_tables(scene_file(tmp_path, "0002"))[table], token)
    assert {key: changed[key] for key in changes} == changes


def test_a_deleted_file_is_recreated_and_a_damaged_one_refused_naming_it(root, tmp_path):
    index_tables(root, VERSION, SCENES, tmp_path)
    file = scene_file(tmp_path, "0003")
    whole = file.read_bytes()
    for lost in (file, tmp_path / scene_tables.INDEX):
        lost.unlink()
        index_tables(root, VERSION, SCENES, tmp_path)
        assert file.read_bytes() == whole and lost.is_file()
    for content in (whole[:-9], b"[]\n", b'{"other": {}}\n', b"\xff"):
        file.write_bytes(content)
        with pytest.raises(DatasetError, match=r"0003\.jsonl is damaged.*delete it and rerun"):
            read_scene_tables(file)


ROWS = [{"token": "ä}]", "text": 'a "quoted"  ], [ text', "nested": [[1.5, -2], {"a": {}}]}, {}, {"token": "b" * 50}]


@pytest.mark.parametrize(
    ("chunk", "indent", "content"), [(7, None, ROWS), (7, 4, ROWS * 3), (64, 0, ROWS), (64, None, []), (2**22, 4, ROWS)]
)
def test_rows_equal_those_of_json_for_any_chunk_size(tmp_path, monkeypatch, chunk, indent, content):
    monkeypatch.setattr(scene_tables, "_CHUNK", chunk)
    (tmp_path / "table.json").write_text(" \n" + json.dumps(content, indent=indent, ensure_ascii=False) + "\n")
    found = list(rows(tmp_path / "table.json"))
    assert [row for _, row in found] == content
    assert [json.loads(text) for text, _ in found] == content and not any("\n" in text for text, _ in found)


def test_a_large_table_is_read_in_bounded_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_tables, "_CHUNK", 2**14)
    row = {"token": "0" * 32, "translation": [1.0, 2.0, 3.0]}
    (tmp_path / "table.json").write_text(json.dumps([row] * 30_000))
    tracemalloc.start()
    try:
        assert sum(1 for _ in rows(tmp_path / "table.json")) == 30_000
        assert tracemalloc.get_traced_memory()[1] < 400_000, "the table has 2.3 MB"
    finally:
        tracemalloc.stop()
