"""Metrics of rendered LiDAR scans against figures computed by hand, and baselines: held-out scans from other scans."""

import dataclasses

import numpy as np
import pytest
from helpers.scan_drives import AZIMUTHS, BEAMS, KEY_FRAME_US, STEPS, directions, recorded, room, scene_of, track_of

from drivesplat.evaluation import scan_baselines
from drivesplat.evaluation.scan_baselines import (
    NO_TRAINING_SCAN,
    baseline_record,
    fused,
    nearest_scan,
    neighbouring_scans,
)
from drivesplat.evaluation.scan_metrics import FIGURES, MIN_RAYS, SCAN_REGIONS, scan_metrics, scan_regions
from drivesplat.evaluation.scene_metrics import side_by_side
from drivesplat.lidar.moved_sensor import sensor_poses_of
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import NO_OBJECT, ScanRecords

TARGET = recorded(room(), timestamp=KEY_FRAME_US)


def test_a_scan_in_its_own_rays_is_itself():
    ranges = room()
    ranges[1, 5:9] = np.nan
    measured = np.ones(ranges.shape, dtype=bool)
    measured[2, 30] = False
    scan = recorded(ranges, 0.3, measured=measured)
    found = fused([scan], scan)
    shown = np.isfinite(ranges) & measured
    np.testing.assert_array_equal(found.returned, shown)
    np.testing.assert_allclose(found.ranges[shown], ranges[shown], rtol=1e-5)
    np.testing.assert_allclose(found.intensities[shown], 0.3, rtol=1e-5)
    np.testing.assert_array_equal(found.drops, ~shown)


def test_returns_are_moved_with_the_sensor():
    """A wall 20 m ahead of a scan is 15 m ahead of a sensor that is 5 m further on. Rays are 2.5 degrees apart."""
    ranges = room(np.nan)
    ahead = np.abs(AZIMUTHS) < 0.5
    ranges[2, ahead] = 20.0 / np.cos(AZIMUTHS[ahead])
    found = fused([recorded(ranges)], recorded(room(), place=(5.0, 0.0, 0.0)))
    met = found.returned[2]
    np.testing.assert_allclose(found.ranges[2, met] * np.cos(AZIMUTHS[met]), 15.0, atol=0.2)
    assert met[STEPS // 2] and found.ranges[2, STEPS // 2] == pytest.approx(15.0, abs=0.01)
    assert met.sum() > 20 and not found.returned[[0, 1, 3]].any()


def test_of_several_returns_a_ray_meets_the_nearest_with_its_intensity():
    near, far = room(8.0), room(9.0)
    near[:, 70:] = np.nan
    found = fused([recorded(far, 0.9), recorded(near, 0.1)], TARGET)
    expected = np.where(np.isfinite(near), 8.0, 9.0)
    np.testing.assert_allclose(found.ranges, expected, rtol=1e-5)
    np.testing.assert_allclose(found.intensities, np.where(expected == 8.0, 0.1, 0.9), rtol=1e-5)
    without = fused([recorded(far, None), recorded(near, 0.1)], TARGET)
    assert without.intensities is None and without.returned.all()


def test_the_nearest_training_scan_in_time_is_taken_and_the_neighbours_are_fused():
    training = [recorded(room(float(5 + i)), timestamp=t * KEY_FRAME_US) for i, t in enumerate((0, 3, 8))]
    target = recorded(room(), timestamp=4 * KEY_FRAME_US)
    np.testing.assert_allclose(nearest_scan(target, training).ranges, 6.0, rtol=1e-5)
    training[1].scan.returned[:, :40] = False
    both = neighbouring_scans(target, training).ranges
    np.testing.assert_allclose(both[:, :40], 7.0, rtol=1e-5)
    np.testing.assert_allclose(both[:, 40:], 6.0, rtol=1e-5)
    last = recorded(room(), timestamp=9 * KEY_FRAME_US)
    np.testing.assert_allclose(neighbouring_scans(last, training).ranges, 7.0, rtol=1e-5)
    with pytest.raises(ValueError, match="no training scan of LiDAR top"):
        nearest_scan(target, [target])


def test_rays_leave_from_where_the_sensor_was_at_their_times():
    """A sensor at 10 m/s that turns: points of a scan and the rays that meet them are at the same times."""
    offsets = np.broadcast_to(np.linspace(-0.1, 0.0, STEPS, dtype=np.float32), (4, STEPS))
    scan = recorded(room())
    rays = type(scan.scan.rays)(scan.scan.rays.azimuths, scan.scan.rays.elevations, offsets)
    moving = type(scan)(**{
        **vars(scan), "scan": type(scan.scan)(rays, scan.scan.returned, scan.scan.ranges, scan.scan.intensities),
        "linear": np.array([10.0, 0.0, 0.0]), "angular": np.array([0.0, 0.0, 0.5]),
    })  # fmt: skip
    poses = sensor_poses_of(moving)(np.array([-0.1, 0.0]))
    np.testing.assert_allclose(poses[:, 0, 3], [-1.0, 0.0])
    np.testing.assert_allclose(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), [-0.05, 0.0], atol=1e-12)
    first = scan_baselines.measured_points(moving)[0]
    local = poses[0, :3, :3] @ (rays.directions()[0, 0] * 12.0) + poses[0, :3, 3]
    np.testing.assert_allclose(first, local, atol=1e-5)
    found = fused([moving], moving)
    assert found.returned.mean() > 0.97, "near the seam, a point may be met a revolution later"
    np.testing.assert_allclose(found.ranges[:, 2:-2], 12.0, atol=1e-5)
    ignored = fused([moving], scan).ranges
    assert np.abs(ignored[ignored > 0] - 12.0).max() > 0.5, "the motion matters"


SCENE = dataclasses.replace(scene_of([]), key_frame_timestamps=np.arange(5) * KEY_FRAME_US)


def scan(key_frame: int, radius: float, group: str = "train", lidar: str = "top"):
    made = recorded(room(radius), timestamp=key_frame * KEY_FRAME_US, group=group)
    return dataclasses.replace(made, lidar=lidar)


def test_held_out_scans_are_measured_by_group_against_each_baseline():
    """A room of 10 m between rooms of 9.5 m and 9.8 m: the earlier one is the nearest in time, of both a ray meets the
    nearer wall. The last scan is compared with the one before it by both."""
    scans = [scan(0, 9.8), scan(1, 9.5), scan(2, 10.0, "interpolation"), scan(4, 9.8), scan(5, 11.0, "extrapolation")]
    record = baseline_record(SCENE, ScanRecords(scans, []))
    assert record["scene"] == "hand" and list(record["baselines"]) == list(scan_baselines.BASELINES)
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


RAYS = len(BEAMS) * STEPS
DRIVING = track_of("car", [(5.0 * i, 0.0, 0.0) for i in range(3)])
PARKED = track_of("van", [(0.0, 8.0, 0.0)] * 3)
WALKING = track_of("person", [(0.0, i, 0.0) for i in range(3)], ObjectClass.PEDESTRIAN)
STREET = dataclasses.replace(scene_of([], DRIVING, PARKED, WALKING), key_frame_timestamps=np.arange(3) * KEY_FRAME_US)


def rendered(ranges: np.ndarray, drops: np.ndarray | float = 0.0, intensity: float | None = 0.5) -> RenderedScan:
    shades = None if intensity is None else np.full(ranges.shape, intensity)
    return RenderedScan(np.nan_to_num(ranges), np.broadcast_to(np.asarray(drops, float), ranges.shape), shades)


def test_errors_are_pooled_over_scans_and_rays_that_both_return():
    """One scan is 10 cm off, another 30 cm, whose range and intensity are wild where one of both does not return."""
    random, first, second = np.random.default_rng(0), room(), room()
    off = random.uniform(0.0, 0.2, first.shape)
    second[0, :40] = np.nan
    wild = np.where(np.isnan(second), 77.0, second + 0.3)
    drops = np.zeros(second.shape)
    drops[3, :10] = 0.9
    wild[3, :10] = 55.0
    pairs = [
        (recorded(first, 0.5), rendered(first + off, 0.0, 0.6)),
        (recorded(second, 0.2), rendered(wild, drops, 0.5)),
    ]
    figures = scan_metrics(STREET, pairs)["all"]
    both = RAYS - 40 - 10
    errors = np.sort(np.concatenate([off.ravel(), np.full(both, 0.3)]))
    assert figures["range_error_median_m"] == pytest.approx(np.median(errors), abs=1e-5)
    assert figures["range_error_median_sq"] == pytest.approx(np.median(errors**2), abs=1e-5)
    kept = errors[: int(np.ceil(0.95 * len(errors)))]
    assert figures["range_error_mean_m"] == pytest.approx(kept.mean(), abs=1e-5)
    squared = (RAYS * 0.1**2 + both * 0.3**2) / (RAYS + both)
    assert figures["intensity_rmse"] == pytest.approx(squared**0.5, abs=1e-6)
    assert figures["drop_accuracy"] == pytest.approx(1.0 - 50 / (2 * RAYS))
    assert (figures["rays"], figures["returns"]) == (2 * RAYS, 2 * RAYS - 40)


def test_the_chamfer_distance_is_the_mean_of_both_ways():
    ranges = room()
    nearer = ranges.copy()
    nearer[0] = 6.0
    figures = scan_metrics(STREET, [(recorded(ranges), rendered(nearer))])["all"]
    cloud, other = ((directions() * r[..., None]).reshape(-1, 3) for r in (ranges, nearer))
    pairs = np.linalg.norm(cloud[:, None] - other, axis=-1)
    assert figures["chamfer_m"] == pytest.approx(0.5 * (pairs.min(axis=1).mean() + pairs.min(axis=0).mean()), rel=1e-4)
    assert figures["chamfer_m"] > 0.5


def test_regions_go_by_the_boxes_of_recorded_returns_and_unmeasured_rays_count_nowhere():
    ranges, objects = room(), np.full((len(BEAMS), STEPS), NO_OBJECT, dtype=np.int16)
    objects[0, :50], objects[1, :50], objects[2, :50] = 0, 1, 2
    ranges[3, :30] = np.nan
    measured = np.ones(ranges.shape, dtype=bool)
    measured[:, 45:47] = False
    found = scan_regions(STREET, recorded(ranges, objects=objects, measured=measured, timestamp=KEY_FRAME_US))
    assert set(found) == set(SCAN_REGIONS)
    np.testing.assert_array_equal(found["all"], measured)
    np.testing.assert_array_equal(found["static"], measured & (objects == NO_OBJECT))
    np.testing.assert_array_equal(found["moving_vehicle"], measured & (objects == 0)), "neither parked nor on foot"
    assert found["static"][3, :30].all(), "rays without a return lie in no box"


def test_the_region_of_moving_vehicles_has_their_errors_alone_and_few_rays_no_figures():
    for rays in (120, MIN_RAYS - 1):
        ranges, objects = room(), np.full((len(BEAMS), STEPS), NO_OBJECT, dtype=np.int16)
        objects[0, :rays] = 0
        wrong = np.where(objects == 0, ranges + 2.0, ranges)
        figures = scan_metrics(STREET, [(recorded(ranges, objects=objects, timestamp=KEY_FRAME_US), rendered(wrong))])
        moving = figures["moving_vehicle"]
        assert figures["static"]["range_error_median_m"] < 1e-5 and moving["rays"] == moving["returns"] == rays
        assert moving["range_error_median_m"] == (pytest.approx(2.0, abs=1e-5) if rays == 120 else None)
    counts = {"rays": MIN_RAYS - 1, "returns": MIN_RAYS - 1}
    assert moving == {**dict.fromkeys(FIGURES), **counts, "unavailable": "fewer than 100 measured rays"}
    assert scan_metrics(STREET, [])["all"]["unavailable"] == "fewer than 100 measured rays"
    with pytest.raises(ValueError, match="a rendered scan of"):
        scan_metrics(STREET, [(recorded(room()), rendered(room()[:, 1:]))])


@pytest.mark.parametrize(
    ("ranges", "predicted", "reason", "accuracy"),
    [
        (np.full((4, STEPS), np.nan), rendered(room()), "no ray returns", 0.0),
        (room(), rendered(room(), 1.0), "no ray returns in both scans", 0.0),
        (room(), rendered(np.zeros((4, STEPS))), "no ray returns in both scans", 0.0),
        (np.full((4, STEPS), np.nan), rendered(room(), 1.0), "no ray returns", 1.0),
    ],
)
def test_without_returns_only_the_drops_are_measured(ranges, predicted, reason, accuracy):
    figures = scan_metrics(STREET, [(recorded(ranges), predicted)])["all"]
    assert figures["unavailable"] == reason and figures["drop_accuracy"] == accuracy
    assert all(figures[name] is None for name in FIGURES if name != "drop_accuracy")
