"""LiDAR scans of simple models against the truth of a street that can be cast by hand: a wall, and a car before it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.drives import LIDAR_AT, ORIGIN, seconds_of
from helpers.hand_made import actors_of, round_gaussians
from helpers.hand_made_street import AHEAD, DRIVERS, SETTINGS, straight, street_scene
from helpers.hand_made_street import SPEED as CAR_SPEED
from helpers.samples import sampled
from helpers.scanned_street import REVOLUTION_S, scan_records
from helpers.scanned_street import SPEED as EGO_SPEED
from torch import nn

from drivesplat.errors import ResultError
from drivesplat.evaluation.scan_truth import ScanTruth, lateral_scan_metrics, removal_scan_metrics, scan_truth_metrics
from drivesplat.evaluation.summary import sentences
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import ActorTrack
from drivesplat.readers.truth import TRUTH_FILE, Truth, TruthScan, read_truth, write_truth_file
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene

CPU, SPREAD, MARGIN = torch.device("cpu"), (3e-4, 3e-4), 0.1
WALL_AT, LENGTH, WIDTH, HEIGHT = 60.0, *DRIVERS[AHEAD].size
ELEVATIONS, AZIMUTHS = np.linspace(-0.12, 0.04, 9), np.linspace(-0.4, 0.4, 201)
"""Azimuths clockwise from ahead: here the sensor's x axis, in a world's own truth its y axis."""
OFFSETS = REVOLUTION_S * ((AZIMUTHS + np.pi) / (2.0 * np.pi) - 1.0)
KEY_FRAMES = (2, 3, 5)


def cast(seconds: float, left: float, with_car: bool) -> dict[str, np.ndarray]:
    """The rays (beams, steps) of a revolution, each at its own time."""
    up, around = np.meshgrid(ELEVATIONS, AZIMUTHS, indexing="ij")
    x, y, z = np.cos(up) * np.cos(around), -np.cos(up) * np.sin(around), np.sin(up)
    sensor = LIDAR_AT[0] + EGO_SPEED * (seconds + OFFSETS), left, LIDAR_AT[2]
    ranges, instances = (WALL_AT - sensor[0]) / x, np.zeros(x.shape, dtype=np.uint8)
    if with_car:
        # seconds count from the first key frame here, from the first image, 35 ms before, in `straight`
        _, beside, middle = straight(0.0)[:3, 3]
        rear = 9.0 + CAR_SPEED * (seconds + 0.035 + OFFSETS) - 0.5 * LENGTH
        distance = (rear - sensor[0]) / x
        on_rear = np.abs(left + distance * y - beside) < 0.5 * WIDTH
        on_rear &= np.abs(sensor[2] + distance * z - middle) < 0.5 * HEIGHT
        ranges, instances = np.where(on_rear, distance, ranges), on_rear.astype(np.uint8)
    returned = np.ones(x.shape, dtype=bool)
    returned[-1] = False
    ranges[-1] = np.inf
    return {
        "range": ranges.astype(np.float32), "intensity": np.full(x.shape, 0.5, np.float32), "instance": instances,
        "returned": returned,
    }  # fmt: skip


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    return street_scene(tiny_scene)


@pytest.fixture(scope="module")
def path(scene, tmp_path_factory) -> Path:
    """The truth: recorded, from both sides, and without the car. Azimuths count from the sensor's y axis."""
    root = tmp_path_factory.mktemp("truth")
    folder = (root / TRUTH_FILE).parent
    folder.mkdir(parents=True)
    np.savez(folder / "pattern.npz", elevations=ELEVATIONS, azimuths=AZIMUTHS + 0.5 * np.pi, offsets=OFFSETS)
    scans = []
    views = [("recorded", 0.0, None), ("left", 2.0, None), ("right", -2.0, None), ("no", 0.0, AHEAD)]
    for name, left, without in views:
        for index in KEY_FRAMES:
            sweep = scene.sweeps[index]
            seconds = seconds_of(sweep.timestamp)
            np.savez(folder / f"{name}{index}.npz", **cast(seconds, left, without is None))
            pose = rigid(np.eye(3), ORIGIN + LIDAR_AT + [EGO_SPEED * seconds, left, 0.0])
            pose[:3, 3] += [7.0, -5.0, 0.3]  # recorded poses have errors that do not count
            scans.append(TruthScan(sweep.token, index, pose.tolist(), left, None, without, f"{name}{index}.npz"))
    scans.append(TruthScan(scene.sweeps[4].token, 4, scans[0].sensor_to_global, 4.0, "edited", None, "none.npz"))
    truth = Truth(
        scene="0001", width=8, height=8, samples_per_pixel=1, leading=AHEAD, instances={"1": AHEAD}, classes={},
        views=(), pattern="pattern.npz", scans=tuple(scans),
    )  # fmt: skip
    write_truth_file(root, truth)
    return root / TRUTH_FILE


@pytest.fixture(scope="module")
def known(path, scene) -> ScanTruth:
    return ScanTruth.of(read_truth(path), path, scene, scan_records(scene), 2.5)


def set_lidar_logits(part: nn.Module, intensity: float) -> None:
    made = torch.zeros(len(part), 4, 2)
    made[:, 0] = torch.tensor([np.log(intensity / (1.0 - intensity)), 5.0])
    part.params["lidar_logits"] = nn.Parameter(made)


def street(wall_at: float = WALL_AT, car_ahead: float = 0.0, intensity: float = 0.5) -> SplatModel:
    """The wall and the rear of the car, which is `car_ahead` metres too far; both are flat."""
    y, z = np.meshgrid(np.arange(-28.0, 28.1, 0.5), np.arange(-6.0, 5.1, 0.5))
    wall = round_gaussians(np.stack([np.full(y.size, wall_at), y.ravel(), z.ravel()], axis=1), 0.5, 0.99)
    y, z = np.meshgrid(np.linspace(-0.85, 0.85, 18), np.linspace(-0.7, 0.7, 15))
    rear = np.stack([np.full(y.size, car_ahead - 0.5 * LENGTH), y.ravel(), z.ravel()], axis=1)
    track = ActorTrack(AHEAD, np.array(DRIVERS[AHEAD].size), DRIVERS[AHEAD].motion)
    car = actors_of(track, count=len(rear), settings=SETTINGS.actors, shaken=False)
    with torch.no_grad():
        car.params["means"].copy_(torch.from_numpy(rear))
        car.params["scales"].fill_(float(np.log(0.08)))
        car.params["opacities"].fill_(5.0)
    for part in (wall, car):
        set_lidar_logits(part, intensity)
        with torch.no_grad():
            part.params["scales"][:, 0] = np.log(0.01)
    return SplatModel([wall, car], None).requires_grad_(False)


def test_true_scans_are_seen_from_the_recorded_place_moved_as_the_truth_says(known, scene):
    recorded, left = ([scan for scan, *_ in known.scans(left_m)] for left_m in (0.0, 2.0))
    assert [scan.sample_index for scan in recorded] == [*KEY_FRAMES]
    for one, other in zip(recorded, left, strict=True):
        sweep = scene.sweeps[one.sample_index]
        np.testing.assert_allclose(one.sensor_to_world, sweep.sensor_to_world, atol=1e-9)
        np.testing.assert_allclose(
            other.sensor_to_world[:3, 3] - one.sensor_to_world[:3, 3], [0.0, 2.0, 0.0], atol=1e-6
        )
        np.testing.assert_allclose(other.linear, [EGO_SPEED, 0.0, 0.0], atol=1e-6)
        assert (np.diff(other.scan.rays.azimuths[0]) > 0).all()
        expected = cast(seconds_of(other.timestamp), 2.0, True)["range"][:-1, ::-1]
        np.testing.assert_allclose(other.scan.ranges[:-1], expected, rtol=1e-6)
        np.testing.assert_allclose(other.scan.rays.azimuths[0], -AZIMUTHS[::-1], atol=1e-6)


def test_scans_from_beside_the_path_are_compared_with_the_truth_from_there(known):
    """The figures have the places of those of images."""
    figures = scan_truth_metrics(street(), known, MARGIN, SPREAD, CPU)
    json.dumps(figures, allow_nan=False)
    assert set(figures) == {"lateral", "removal"}
    assert set(figures["removal"]["lidar"]) == {"box", "outside", "not_removed"}
    group = {"static": None}
    method = {**figures, "interpolation": group, "extrapolation": group, "gaussians": 1, "train_seconds": 1.0}
    assert sentences({"methods": {"m": {**method, "device": "cpu"}}}, "metrics.json")
    found = {offset: view["lidar"] for offset, view in figures["lateral"].items()}
    assert set(found) == {"2.0", "-2.0"}
    for regions in found.values():
        assert set(regions) == {"all", "static", "moving_vehicle"}
        assert regions["static"]["range_error_median_m"] < 0.02 and regions["static"]["intensity_rmse"] < 0.01
        assert regions["moving_vehicle"]["range_error_median_m"] < 0.12, "0.2 % of the light pass the car"
        assert regions["all"]["drop_accuracy"] == pytest.approx(8 / 9, abs=0.01), "the uppermost beam never returns"
    assert found["2.0"]["all"]["rays"] == len(KEY_FRAMES) * 9 * 201
    off = lateral_scan_metrics(street(WALL_AT + 0.5, car_ahead=0.2), known, SPREAD, CPU)["-2.0"]
    assert off["static"]["range_error_median_m"] == pytest.approx(0.51, abs=0.03)
    moved = off["moving_vehicle"]["range_error_median_m"] - found["-2.0"]["moving_vehicle"]["range_error_median_m"]
    assert moved == pytest.approx(0.2, abs=0.05)


def test_without_the_car_its_rays_meet_what_is_behind_it(known):
    found, gaps, shadow = removal_scan_metrics(street(WALL_AT + 0.3), known, MARGIN, SPREAD, CPU), [], 0
    for index in KEY_FRAMES:
        with_car, without = (cast(0.5 * index, 0.0, there) for there in (True, False))
        met = (with_car["instance"] == 1) & with_car["returned"]
        gaps.append(without["range"][met] - with_car["range"][met])
        shadow += int(with_car["instance"].sum())
    assert set(found) == {"box", "outside", "not_removed"}
    assert found["box"]["rays"] == shadow > 100
    assert found["outside"]["rays"] == len(KEY_FRAMES) * 9 * 201 - shadow
    for region in (found["box"], found["outside"], found["not_removed"]["outside"]):
        assert region["range_error_median_m"] == pytest.approx(0.3, abs=0.03)
    untouched = found["not_removed"]["box"]["range_error_median_m"]
    assert untouched == pytest.approx(float(np.median(np.concatenate(gaps))), abs=0.5)


def test_a_model_without_actors_loses_what_lies_in_the_box(known):
    """A car in its static part is removed by its box, in each scan."""
    moving = street()
    car = sampled(moving.parts[1], next(scan.seconds for scan, *_ in known.scans()))
    static = round_gaussians(car.means.numpy(), 0.08, 0.99)
    set_lidar_logits(static, 0.5)
    model = SplatModel([moving.parts[0], static], None).requires_grad_(False)
    found = removal_scan_metrics(model, known, MARGIN, SPREAD, CPU)
    assert found["not_removed"]["box"]["range_error_mean_m"] > found["box"]["range_error_mean_m"] + 1.0


def test_a_missing_or_damaged_file_is_named_in_one_sentence(path, scene, known):
    truth = path.parent / "left2.npz"
    held = truth.read_bytes()
    try:
        truth.write_bytes(b"no archive")
        with pytest.raises(ResultError, match=r"left2\.npz.*not an archive of range, intensity") as damaged:
            lateral_scan_metrics(street(), known, SPREAD, CPU)
        truth.unlink()
        with pytest.raises(ResultError, match=r"left2\.npz is missing") as missing:
            lateral_scan_metrics(street(), known, SPREAD, CPU)
        assert not any("\n" in str(error.value) for error in (damaged, missing))
    finally:
        truth.write_bytes(held)
