"""A method that renders LiDAR through the whole workflow."""

from pathlib import Path

import numpy as np
import pytest
from helpers.mcap_files import Recording
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy

from drivesplat.io.video import read_footage

pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("lidar_workflow")]
SCANS = {"per_image": 0.4}
METHODS = {
    "vanilla": {"parts": ["background"]},
    "with_lidar": {"parts": ["background", "actors"], "overrides": {"train": {"scans": SCANS}}},
}


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    folder = tmp_path_factory.mktemp("lidar") / "workflow"
    made = WorkflowCopy.make(folder, methods=METHODS, train={**TINY_TRAINING, "iterations": 60})
    done = made.run("results/0001/metrics.json")
    assert done.returncode == 0, done.stdout
    return made


def test_metrics_have_lidar_for_the_method_that_renders_it(copy):
    methods = copy.read("results/0001/metrics.json")["methods"]
    for group in ("interpolation", "extrapolation"):
        assert "lidar" not in methods["vanilla"][group]
        lidar = methods["with_lidar"][group]["lidar"]
        assert set(lidar) == {"all", "static", "moving_vehicle"}
        assert lidar["all"]["rays"] > 1000 and lidar["all"]["returns"] > 500
        assert 0.0 < lidar["all"]["range_error_median_m"] < 5.0 and 0.3 < lidar["all"]["drop_accuracy"] <= 1.0
        assert methods["with_lidar"][group]["static"]["psnr"] > 10.0


def test_metrics_have_the_baselines_of_the_same_rays(copy):
    metrics = copy.read("results/0001/metrics.json")
    rendered = metrics["methods"]["with_lidar"]
    assert set(metrics["lidar_baselines"]) == {"nearest_scan", "neighbouring_scans"}
    for baseline in metrics["lidar_baselines"].values():
        for group in ("interpolation", "extrapolation"):
            found, own = baseline[group]["all"], rendered[group]["lidar"]["all"]
            assert (found["rays"], found["returns"]) == (own["rays"], own["returns"])
            assert 0.0 < found["range_error_median_m"] < 5.0
    assert {"scans", "scan_baselines"} < metrics["provenance"]["stages"].keys()


def test_scans_become_a_picture_a_film_and_a_table_of_the_report(copy):
    folder = "results/0001/with_lidar"
    done = copy.run(f"{folder}/lidar.png", f"{folder}/lidar.mp4")
    assert done.returncode == 0, done.stdout
    done = copy.run("report")
    assert done.returncode == 0 and "LiDAR, all rays of held-out scans" in done.stdout, done.stdout
    film, page = copy.read(f"{folder}/lidar.json"), (copy.folder / "results/gap_report.html").read_text()
    assert film["frames"] == len(copy.read("results/0001/scene.json")["sweeps"])
    assert read_footage(copy.folder / folder / "lidar.mp4").frames == film["frames"]
    assert {"scans", "with_lidar/train"} < film["provenance"]["stages"].keys()
    assert 'alt="LiDAR scans"' in page and 'href="0001/with_lidar/lidar.mp4"' in page
    assert copy.read("results/gap_report.json")["lidar"]["rows"][0]["method"] == "with_lidar"
    refused = copy.run("results/0001/vanilla/lidar.mp4")
    assert refused.returncode != 0 and "renders no LiDAR of scene 0001" in refused.stdout


def test_scans_from_beside_the_path_come_as_files_and_a_changed_format_makes_them_again(copy):
    target = "results/0001/with_lidar/trajectories/lateral_2m/scans/scans.json"
    done = copy.run(target)
    assert done.returncode == 0, done.stdout
    record = copy.read(target)
    assert len(record["scans"]) == 10 and record["offset"]["lateral"] == 2.0
    for scan in record["scans"]:
        with np.load(copy.folder / Path(target).parent / scan["files"]["npz"]) as arrays:
            assert (
                arrays["ranges"].shape == arrays["azimuths"].shape and int(arrays["returned"].sum()) == scan["returns"]
            )
    assert record["provenance"]["stages"]["with_lidar/scan_folder"]["settings"]["formats"] == ["npz", "ply"]
    copy.config["export"] = {"scan_formats": ["npz"]}
    copy.write_config()
    assert copy.planned(target) == {"scan_folder": 1}


def test_an_mcap_file_has_the_rendered_scans(copy):
    target = "results/0001/with_lidar/drive.mcap"
    done = copy.run(target)
    assert done.returncode == 0, done.stdout
    assert len(Recording.of(copy.folder / target).all("/LIDAR_TOP/points")) == 10


def test_a_changed_weight_of_scans_trains_that_method_alone_again(copy):
    assert copy.planned("results/0001/metrics.json") == {}
    copy.config["methods"]["with_lidar"]["overrides"]["train"]["scans"] = {**SCANS, "range_weight": 0.2}
    copy.write_config()
    planned = copy.planned("results/0001/metrics.json")
    assert planned["train"] == 1 and "scans" not in planned and "lidar_seed" not in planned
