"""The dataset of a route: a longer drive has the files of a shorter one, and keeps the stretches that it has."""

import json
import shutil
from pathlib import Path

import pytest
from helpers.demo_worlds import job_of, world_of
from helpers.drives import scene_at
from nuscenes.nuscenes import NuScenes

from drivesplat.readers.truth import read_truth
from drivesplat.world.generate import make_world
from drivesplat.world.route import scenery, stretch

PROVENANCE = {"stages": {}, "inputs": {}}
SECONDS = 1
"""Of a stretch in these tests."""


def make(root: Path, seconds: int, **settings) -> None:
    world = world_of(
        route={}, key_frames=2 * seconds + 1, width=64, vehicles=2, pedestrians=1, parked=4, image_hz=10,
        sweeps=("CAM_FRONT",), **settings,
    )  # fmt: skip
    make_world(root, job_of(world), PROVENANCE, workers=2)


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    """The folders of drives of one stretch, of two, and of the first one made longer."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("STRETCH_S", SECONDS), ("HOUSES", 50.0), ("LINE_HOUSES", 100.0), ("LINE_TREES", 60.0)):
            patch.setattr(stretch, name, value)
        patch.setattr(scenery, "MAKES", 3)
        short, long = (tmp_path_factory.mktemp(name) for name in ("short", "long"))
        make(short, SECONDS)
        make(long, 2 * SECONDS)
        extended = tmp_path_factory.mktemp("extended") / "copy"
        shutil.copytree(short, extended)
        before = {path: path.stat().st_mtime_ns for path in extended.rglob("*.jpg")}
        make(extended, 2 * SECONDS)
        assert {path: path.stat().st_mtime_ns for path in before} == before, "they are kept"
        yield short, long, extended


def files(root: Path) -> dict[str, bytes]:
    """The content of all recordings by name."""
    found = [path for folder in ("samples", "sweeps") for path in (root / folder).rglob("*") if path.is_file()]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in found}


def rows(root: Path, table: str) -> dict[str, dict]:
    """The rows of a table by token, without what tells of later ones."""
    later = {"next", "nbr_samples", "last_sample_token", "nbr_annotations", "last_annotation_token", "description"}
    content = json.loads((root / "v1.0-mini" / f"{table}.json").read_text())
    return {row["token"]: {key: value for key, value in row.items() if key not in later} for row in content}


def test_a_longer_drive_has_the_recordings_and_rows_of_a_shorter_one(roots):
    short, long, _ = roots
    common, recordings = files(short), files(long)
    assert len(common) == 2 * SECONDS + 1 + 10 * SECONDS + 1 and len(recordings) == len(common) + 12 * SECONDS
    assert {name: recordings[name] for name in common} == common
    for table in ("sample", "sample_data", "ego_pose", "sample_annotation", "instance", "calibrated_sensor", "scene"):
        own, all_rows = rows(short, table), rows(long, table)
        assert own and {token: all_rows[token] for token in own} == own, table


def test_a_drive_that_was_made_longer_is_one_that_was_made_so(roots):
    _, long, extended = roots
    assert files(extended) == files(long)
    for path in (long / "v1.0-mini").iterdir():
        assert (extended / "v1.0-mini" / path.name).read_bytes() == path.read_bytes()


def test_the_devkit_and_the_projects_reader_load_it(roots):
    _, long, _ = roots
    tables = NuScenes("v1.0-mini", str(long), verbose=False)
    assert len(tables.sample) == 4 * SECONDS + 1 and "Route through a grid" in tables.scene[0]["description"]
    _, boxes, _ = tables.get_sample_data(tables.sample[1]["data"]["CAM_FRONT"])
    assert {"vehicle.car"} <= {box.name for box in boxes} and all(box.center[2] > 0 for box in boxes)
    scene = scene_at(long, dataset="demo", scene="demo", on_missing="stop")
    assert len(scene.frames) == 20 * SECONDS + 1 and len(scene.sweeps) == 4 * SECONDS + 1
    truth = read_truth(long / "truth/truth.json")
    assert truth.views == () and truth.recorded("CAM_FRONT") is None
