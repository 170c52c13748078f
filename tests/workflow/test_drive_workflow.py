"""A drive folder through the whole workflow: what comes out is what its nuScenes tables give."""

from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from helpers.killed_runs import VANILLA
from helpers.workflow_copy import WorkflowCopy, complaints

from drivesplat.errors import DatasetError
from drivesplat.io.point_cloud import read_ply
from drivesplat.readers.drive.write import write_drive
from drivesplat.scene.scene import read_scene

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("drive_workflow")]


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    """The tiny drive's tables, and the drive folder written from them as another scene."""
    datasets = {
        "nuscenes": {"dataroot": "data", "scenes": ["0001"]},
        "mine": {"reader": "drive", "dataroot": "drives", "scenes": ["monday"]},
    }
    made = WorkflowCopy.make(tmp_path_factory.mktemp("drive") / "workflow", datasets=datasets, methods=VANILLA)
    done = made.run("results/0001/metrics.json")
    assert done.returncode == 0, done.stdout
    with chdir(made.folder):
        write_drive(read_scene("results/0001/scene.json"), Path("drives/monday"))
    return made


def test_a_drive_folder_gives_the_seed_and_the_metrics_of_its_tables(copy):
    done = copy.run("results/monday/metrics.json")
    assert done.returncode == 0, done.stdout
    seeds = [read_ply(copy.folder / f"results/{scene}/seed.ply", "lidar_seed") for scene in ("0001", "monday")]
    np.testing.assert_array_equal(seeds[0].positions, seeds[1].positions)
    np.testing.assert_array_equal(seeds[0].colors, seeds[1].colors)
    tables, folder = (copy.read(f"results/{scene}/metrics.json") for scene in ("0001", "monday"))
    assert folder["protocol"]["poses"] == "drive"
    for group in ("interpolation", "extrapolation"):
        assert folder["methods"]["vanilla"][group] == tables["methods"]["vanilla"][group]
    assert copy.planned("results/monday/metrics.json") == {}


def test_a_scene_without_its_images_is_not_written(copy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DatasetError, match=r"none of its 10 images is there \(first: results/\.data"):
        write_drive(read_scene(copy.folder / "results/0001/scene.json"), tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere").exists()


def test_a_changed_drive_json_reruns_its_scene_and_a_fault_stops_it_in_a_line(copy):
    path = copy.folder / "drives/monday/drive.json"
    whole = path.read_text(encoding="utf-8")
    path.write_text(whole.replace('"version": 1', '"version": 2', 1), encoding="utf-8")
    try:
        assert copy.planned("results/monday/own_car.json") == {"extract": 1, "own_car": 1}
        done = copy.run("results/monday/own_car.json")
    finally:
        path.write_text(whole, encoding="utf-8")
    assert done.returncode != 0 and "Traceback" not in done.stdout, done.stdout
    (line,) = complaints(done.stdout)
    assert "drive.json: version is 2" in line, line
