"""The figures of the baselines of LiDAR scans, as metrics.json has them."""

import dataclasses

import numpy as np
import pytest
from helpers.scan_drives import BEAMS, KEY_FRAME_US, STEPS, recorded, room, scene_of

from drivesplat.evaluation.scan_baselines import BASELINES, NO_TRAINING_SCAN, baseline_record
from drivesplat.evaluation.scene_metrics import side_by_side
from drivesplat.scene.scan_record import ScanRecords

SCENE = dataclasses.replace(scene_of([]), key_frame_timestamps=np.arange(5) * KEY_FRAME_US)


def scan(key_frame: int, radius: float, group: str = "train", lidar: str = "top"):
    made = recorded(room(radius), timestamp=key_frame * KEY_FRAME_US, group=group)
    return dataclasses.replace(made, lidar=lidar)


def test_held_out_scans_are_measured_by_group_against_each_baseline():
    """A room of 10 m between rooms of 9.5 m and 9.8 m: the earlier one is the nearest in time, of both a ray meets the
    nearer wall. The last scan is compared with the one before it by both."""
    scans = [scan(0, 9.8), scan(1, 9.5), scan(2, 10.0, "interpolation"), scan(4, 9.8), scan(5, 11.0, "extrapolation")]
    record = baseline_record(SCENE, ScanRecords(scans, []))
    assert record["scene"] == "hand" and list(record["baselines"]) == list(BASELINES)
    nearest, fused = (record["baselines"][name] for name in ("nearest_scan", "neighbouring_scans"))
    found = nearest["interpolation"]["all"]
    assert found["range_error_median_m"] == pytest.approx(0.5, abs=1e-3)
    assert found["rays"] == found["returns"] == len(BEAMS) * STEPS and found["drop_accuracy"] == 1.0
    assert fused["interpolation"]["all"]["range_error_median_m"] == pytest.approx(0.5, abs=1e-3)
    assert nearest["extrapolation"]["all"]["range_error_median_m"] == pytest.approx(1.2, abs=1e-3)
    assert nearest["extrapolation"]["moving_vehicle"]["range_error_median_m"] is None


def test_without_a_training_scan_there_are_no_figures_and_a_reason():
    """Of the same LiDAR: another one's scans do not count."""
    for training in ([], [scan(0, 9.0, lidar="other")]):
        scans = [*training, scan(2, 10.0, "interpolation")]
        found = baseline_record(SCENE, ScanRecords(scans, []))["baselines"]["nearest_scan"]
        figures = found["interpolation"]["all"]
        assert figures["range_error_median_m"] is None and figures["unavailable"] == NO_TRAINING_SCAN
        assert "measured rays" in found["extrapolation"]["all"]["unavailable"], "nothing is held out there"


def test_metrics_have_the_baselines_where_there_are_any():
    one = {"scene": "a", "dataset": "d", "protocol": {}, "drive": {}, "result": {"gaussians": 1}}
    assert "lidar_baselines" not in side_by_side({"vanilla": one})
    assert "tracks_quality" not in side_by_side({"vanilla": one}, None, None), "nothing is annotated"
    assert side_by_side({"vanilla": one}, tracks_quality={"all": {}})["tracks_quality"] == {"all": {}}
    measured = {"baselines": {"nearest_scan": {"interpolation": {}}}}
    assert side_by_side({"vanilla": one}, measured)["lidar_baselines"] == measured["baselines"]
