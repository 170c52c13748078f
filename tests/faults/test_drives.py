"""Drives that lack what others have, from their tables to the metrics of all methods: null, or counted, never NaN."""

import json
import re
import shutil

import pytest
import yaml
from helpers.drives import Thing, World, write_world
from helpers.small_runs import BASE, Finished, run
from helpers.workflow_copy import REPOSITORY

from drivesplat.settings.config import load

pytestmark = pytest.mark.usefixtures("one_thread")

GROUPS = ("interpolation", "extrapolation")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Finished:
    """A van ahead, annotated in key frame 2 alone, which is held out for interpolation; all LiDAR files are gone, where
    `lidar_seed.on_missing` says to go on. Where not, tests/readers/test_nuscenes.py holds that it stops."""
    folder = tmp_path_factory.mktemp("lacking")
    van = Thing("vehicle.truck", (4.0, 4.0, 3.0), (9.0, 0.0, 1.5), seen=range(2, 3))
    root = write_world(folder / "data", World(things=[van], key_frames=8, speed=1.0))
    shutil.rmtree(root / "samples/LIDAR_TOP")
    return run(root, folder, lidar_seed={**BASE["lidar_seed"], "on_missing": "warn"})


def test_a_track_with_one_box_is_static_and_present_only_at_that_time(made):
    json.dumps(made.metrics, allow_nan=False)
    for method in made.metrics["methods"].values():
        seen, gone = (method[group] for group in GROUPS)
        assert seen["vehicle"]["psnr"] > 0 and seen["parked_vehicle"] == seen["vehicle"]
        assert seen["moving_vehicle"] is gone["moving_vehicle"] is gone["vehicle"] is gone["gap_db"] is None
        assert seen["gap_db"] == pytest.approx(seen["static"]["psnr"] - seen["vehicle"]["psnr"])


def test_a_drive_whose_lidar_is_gone_is_measured_with_the_count_beside_it(made):
    assert made.metrics["protocol"]["lidar_missing"] == 8
    for method in made.metrics["methods"].values():
        assert all(method[group]["static"]["psnr"] > 0 and not method[group].get("depth") for group in GROUPS)


def test_a_preset_for_a_small_gpu_requires_its_measured_memory_and_a_margin():
    """docs/measured.md has the peak of the preset; the CUDA context adds half a gigabyte to it."""
    preset = yaml.safe_load((REPOSITORY / "presets/8gb.yaml").read_text())
    (peak,) = re.findall(r"^\| `8gb` \|.*\| ([0-9.]+) GB \|", (REPOSITORY / "docs/measured.md").read_text(), re.M)
    asked = load(preset).device.min_free_gb
    assert float(peak) + 0.5 <= asked < load({}).device.min_free_gb == 8
