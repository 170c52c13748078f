"""Tables in nuScenes' layout by others: names of scenes and classes, fractions of a microsecond, no maps."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.table_files import VERSION, copy_of, edit, extracted
from PIL import Image

from drivesplat.errors import DatasetError

pytestmark = pytest.mark.usefixtures("uncompared")

LIKE_NUSCENES = REPOSITORY / "../shared/data/nuscenes-like-tables"


@pytest.fixture
def root(small_root, tmp_path) -> Path:
    return copy_of(small_root, tmp_path / "data")


@pytest.mark.parametrize("name", ["host-a101-lidar0-1240710366399037786", "0001", "scene-0001"])
def test_a_scene_may_have_any_name(root, name):
    edit(root, "scene", lambda rows: rows[0].update(name=name))
    scene = extracted(root, scene=name)
    assert scene.name == name and len(scene.frames) > 3
    with pytest.raises(DatasetError, match=f"scene 0002 is not in .*; there are: {name.removeprefix('scene-')}$"):
        extracted(root, scene="0002")


def test_of_two_names_the_whole_one_is_taken(root):
    """The scene called 0001 has no samples of its own; scene-0001 has them."""
    edit(root, "scene", lambda rows: [{**rows[0], "token": "other", "name": "0001"}, *rows])
    with pytest.raises(DatasetError, match="not in the tables"):
        extracted(root, scene="0001")
    assert extracted(root, scene="scene-0001").name == "scene-0001"


def test_fractions_of_a_microsecond_are_rounded_to_the_nearest(root):
    """Half of a microsecond is rounded down: 83.5 to 83."""
    whole = {table: json.loads((root / VERSION / f"{table}.json").read_text()) for table in ("sample", "sample_data")}
    for table, fraction in (("sample", 0.5), ("sample_data", 0.75)):
        edit(root, table, lambda rows, by=fraction: [{**it, "timestamp": it["timestamp"] + by} for it in rows])
    scene = extracted(root)
    assert scene.key_frame_timestamps.tolist() == [row["timestamp"] for row in whole["sample"]]
    times = {row["token"]: row["timestamp"] + 1 for row in whole["sample_data"]}
    assert all(frame.timestamp == times[frame.token] for frame in scene.frames)
    edit(root, "sample", lambda rows: rows[1].update(timestamp=rows[1]["timestamp"] * 1e-6))
    with pytest.raises(DatasetError, match="must be a whole number of microseconds"):
        extracted(root)


def test_the_beams_of_nuscenes_lidar_are_not_taken_for_those_of_other_tables(root):
    assert len(extracted(root).lidars[0].beam_elevations) == 32
    shutil.move(root / VERSION, root / "annotation")
    (lidar,) = extracted(root, version="annotation").lidars
    assert (lidar.beam_elevations, lidar.azimuth_steps, lidar.spin) == (None, None, None)
    (root / "maps").unlink()
    assert len(extracted(root, version="annotation").key_frame_timestamps) == 3, "maps are not needed"


def test_tier_ivs_tables_are_read():
    if not LIKE_NUSCENES.is_dir():
        pytest.skip(f"the recorded tables are not in {LIKE_NUSCENES}")
    scene = extracted(LIKE_NUSCENES / "t4", version="annotation", scene="minimal_test_scene", on_missing="warn")
    assert (len(scene.frames), len(scene.sweeps)) == (3, 3)
    assert [track.object_class for track in scene.tracks] == ["car", "pedestrian", "bicycle"]


def test_lyfts_tables_are_read(tmp_path):
    """One sample of a scene; its files are stood in for."""
    if not LIKE_NUSCENES.is_dir():
        pytest.skip(f"the recorded tables are not in {LIKE_NUSCENES}")
    version = "v1.01-train"
    tables = {file.name: json.loads(file.read_text()) for file in (LIKE_NUSCENES / "lyft" / version).glob("*.json")}
    (sample,), (record,) = tables["sample.json"], tables["scene.json"]
    sample["next"], record["first_sample_token"] = "", sample["token"]
    (tmp_path / version).mkdir()
    for name, rows in tables.items():
        (tmp_path / version / name).write_text(json.dumps(rows))
    front = next(row for row in tables["sample_data.json"] if "cam0" in row["filename"])
    (tmp_path / "images").mkdir()
    Image.new("RGB", (1920, 1080)).save(tmp_path / front["filename"], format="JPEG")
    scene = extracted(
        tmp_path, version=version, scene=record["name"], sweeps=False, lidar_sweeps=False, on_missing="warn"
    )
    assert sample["timestamp"] == 1556675185903083.2 and scene.key_frame_timestamps.tolist() == [1556675185903083]
    assert [frame.timestamp for frame in scene.frames] == [1556675185850000]
    assert [track.object_class for track in scene.tracks] == ["car"] * len(scene.tracks)
    np.testing.assert_allclose(scene.tracks[0].size, [4.495, 2.046, 1.849])
