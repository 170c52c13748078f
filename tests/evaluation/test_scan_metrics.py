"""Metrics of rendered LiDAR scans, against figures computed by hand."""

import dataclasses

import numpy as np
import pytest
from helpers.scan_drives import BEAMS, KEY_FRAME_US, STEPS, directions, recorded, room, scene_of, track_of

from drivesplat.evaluation.scan_metrics import FIGURES, MIN_RAYS, SCAN_REGIONS, scan_metrics, scan_regions
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import NO_OBJECT

RAYS = len(BEAMS) * STEPS
DRIVING = track_of("car", [(5.0 * i, 0.0, 0.0) for i in range(3)])
PARKED = track_of("van", [(0.0, 8.0, 0.0)] * 3)
WALKING = track_of("person", [(0.0, i, 0.0) for i in range(3)], ObjectClass.PEDESTRIAN)
SCENE = dataclasses.replace(
    scene_of([], DRIVING, PARKED, WALKING), key_frame_timestamps=np.arange(3) * KEY_FRAME_US
)  # fmt: skip


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
    figures = scan_metrics(SCENE, pairs)["all"]
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
    figures = scan_metrics(SCENE, [(recorded(ranges), rendered(nearer))])["all"]
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
    found = scan_regions(SCENE, recorded(ranges, objects=objects, measured=measured, timestamp=KEY_FRAME_US))
    assert set(found) == set(SCAN_REGIONS)
    np.testing.assert_array_equal(found["all"], measured)
    np.testing.assert_array_equal(found["static"], measured & (objects == NO_OBJECT))
    np.testing.assert_array_equal(found["moving_vehicle"], measured & (objects == 0)), "neither parked nor on foot"
    assert found["static"][3, :30].all(), "rays without a return lie in no box"


def test_the_region_of_moving_vehicles_has_their_errors_alone():
    ranges, objects = room(), np.full((len(BEAMS), STEPS), NO_OBJECT, dtype=np.int16)
    objects[0, :120] = 0
    wrong = np.where(objects == 0, ranges + 2.0, ranges)
    record = recorded(ranges, objects=objects, timestamp=KEY_FRAME_US)
    figures = scan_metrics(SCENE, [(record, rendered(wrong))])
    assert figures["moving_vehicle"]["range_error_median_m"] == pytest.approx(2.0, abs=1e-5)
    assert figures["moving_vehicle"]["rays"] == 120 and figures["static"]["range_error_median_m"] < 1e-5


def test_few_rays_have_no_figures_and_say_why():
    objects = np.full((len(BEAMS), STEPS), NO_OBJECT, dtype=np.int16)
    objects[0, : MIN_RAYS - 1] = 0
    record = recorded(room(), objects=objects, timestamp=KEY_FRAME_US)
    figures = scan_metrics(SCENE, [(record, rendered(room()))])["moving_vehicle"]
    counts = {"rays": MIN_RAYS - 1, "returns": MIN_RAYS - 1}
    assert figures == {**dict.fromkeys(FIGURES), **counts, "unavailable": "fewer than 100 measured rays"}
    assert scan_metrics(SCENE, [])["all"]["unavailable"] == "fewer than 100 measured rays"


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
    figures = scan_metrics(SCENE, [(recorded(ranges), predicted)])["all"]
    assert figures["unavailable"] == reason and figures["drop_accuracy"] == accuracy
    assert all(figures[name] is None for name in FIGURES if name != "drop_accuracy")


def test_a_rendered_scan_of_other_rays_is_refused():
    with pytest.raises(ValueError, match="a rendered scan of"):
        scan_metrics(SCENE, [(recorded(room()), rendered(room()[:, 1:]))])
