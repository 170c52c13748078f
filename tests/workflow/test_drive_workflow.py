"""A drive folder through the whole workflow: what comes out is what its nuScenes tables give."""

from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from helpers.killed_runs import only_complaint
from helpers.shared_runs import TWO_METHODS, VANILLA
from helpers.workflow_copy import WorkflowCopy, complaints

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.write import write_drive
from drivesplat.scene.scene import read_scene

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("drive_workflow")]


@pytest.fixture(scope="module")
def copy(finished_run, tmp_path_factory) -> WorkflowCopy:
    """The tiny drive's tables, measured, and the drive folder written from them as another scene."""
    made = finished_run.again(tmp_path_factory.mktemp("drive") / "workflow")
    made.config["datasets"] = {
        "nuscenes": {"dataroot": "data", "scenes": ["0001"]},
        "mine": {"reader": "drive", "dataroot": "drives", "scenes": ["monday"]},
    }
    made.config["methods"] = VANILLA
    made.write_config()
    with chdir(made.folder):
        write_drive(read_scene("results/0001/scene.json"), Path("drives/monday"))
    return made


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
    assert "drive.json: version is 2" in only_complaint(done)


@pytest.mark.parametrize(
    "flags", [("-n",), *(pytest.param(flags, marks=pytest.mark.slow) for flags in (("-n", "--quiet", "all"), ()))]
)
def test_a_drive_that_is_unfit_for_the_settings_is_refused_before_any_job(copy, flags, tmp_path):
    with copy.set_to(holdout={"last_block": 10}, results_dir="other"):
        done, unfit = (copy.run(f"other/monday/{name}", flags=flags) for name in ("own_car.json", "metrics.json"))
    assert done.returncode == 0, "these settings do not concern it"
    assert unfit.returncode == 1
    (line,) = complaints(unfit.stdout)
    assert "scene monday: the hold-out leaves none of its 10 key frames to train on" in line
    assert not (copy.folder / "other/monday/seed.ply").exists() and "Job stats" not in unfit.stdout


EDITS = """\
edits:
  gone:
    - remove: {track: 0001 instance 0}
  shifted:
    - shift: {track: 0001 instance 0, lateral: 1.0}
"""


@pytest.mark.slow
def test_this_workflow_trains_on_a_rendered_drive_and_on_its_tables(copy):
    """The edited drive as a drive folder and as nuScenes tables; both give the same figures, with the edited tracks."""
    folder = copy.folder
    (folder / "edits.yaml").write_text(EDITS)
    copy.config["methods"] = TWO_METHODS
    copy.config["datasets"]["nuscenes"]["edits"] = {"0001": "edits.yaml"}
    for edit in ("gone", "shifted"):
        drive = f"results/0001/street/edits/{edit}/drive"
        copy.config["datasets"] |= {
            edit: {"reader": "drive", "dataroot": drive, "scenes": [edit]},
            f"{edit}_tables": {
                "reader": "nuscenes", "dataroot": f"{drive}/nuscenes", "version": "v1.0-rendered",
                "scenes": [f"0001_{edit}"],
            },
        }  # fmt: skip
    copy.config["lidar_seed"] = {**copy.config.get("lidar_seed", {}), "on_missing": "warn"}
    copy.write_config()
    drives = [f"results/0001/street/edits/{edit}/drive/drive.json" for edit in ("gone", "shifted")]
    done = copy.run(*drives)
    assert done.returncode == 0, done.stdout
    assert copy.planned(*drives) == {}
    done = copy.run("results/shifted/metrics.json", "results/0001_shifted/metrics.json", "results/gone/tracks.csv")
    assert done.returncode == 0, done.stdout
    rendered, tables = (copy.read(f"results/{scene}/metrics.json") for scene in ("shifted", "0001_shifted"))
    assert rendered["methods"].keys() == {"vanilla", "street"}
    for method in ("vanilla", "street"):
        measured = [one["methods"][method]["interpolation"] for one in (rendered, tables)]
        pixels = [
            {name: one["pixels"] for name, one in of_drive.items() if isinstance(one, dict)} for of_drive in measured
        ]
        assert pixels[0] == pixels[1] and pixels[0]["static"] > 0
        assert measured[0]["static"]["psnr"] == pytest.approx(measured[1]["static"]["psnr"], abs=1.0)
    recorded = read_scene(folder / "results/0001/scene.json")
    gone, shifted = (read_scene(folder / f"results/{edit}/scene.json") for edit in ("gone", "shifted"))
    (moved,) = {track.id for track in shifted.tracks} - {track.id for track in gone.tracks}
    places = [scene.track(moved).object_to_world for scene in (recorded, shifted)]
    np.testing.assert_allclose(places[1][:, :3, 3] - places[0][:, :3, 3], places[0][:, :3, 1], atol=0.2)
