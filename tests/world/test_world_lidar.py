"""The demo world's LiDAR: 32 beams as in nuScenes, range limits, independent noise per sweep."""

import numpy as np
import pytest
from helpers.demo_worlds import LIDAR, RIG, names_of, recorder_of, world_of

from drivesplat.world.optics.rig import trigger_times
from drivesplat.world.recorder import Recorder


@pytest.fixture(scope="module")
def standing() -> Recorder:
    """A static street: sweeps differ only in noise."""
    return recorder_of(ego="stands", vehicles=0, pedestrians=0)


@pytest.fixture(scope="module")
def points(standing) -> np.ndarray:
    return standing.sweep(LIDAR, 0)


def test_returns_are_rows_of_five_floats_within_range(points):
    assert points.dtype == np.float32 and points.shape[1] == 5
    assert np.isfinite(points).all()
    assert 15_000 < len(points) < 32 * 1085
    ranges, intensity = np.linalg.norm(points[:, :3], axis=1), points[:, 3]
    assert ranges.min() > 0.8 and 50.0 < ranges.max() < 100.1
    assert intensity.min() >= 0 and intensity.max() <= 255 and (intensity == intensity.round()).all()


def test_rings_are_32_beams_from_the_lowest_to_the_highest_elevation(points):
    x, y, z, _, ring = points.astype(np.float64).T
    assert set(np.unique(ring)) == set(range(32))
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    step = (10.67 + 30.67) / 31
    assert np.abs(elevation - (-30.67 + step * ring)).max() < 0.01
    assert elevation.min() > -31.0 and elevation.max() < 11.0


def test_the_road_below_is_flat_at_the_sensors_height(points, standing):
    to_ego = LIDAR.sensor_to_ego
    in_ego = points[:, :3].astype(np.float64) @ to_ego[:3, :3].T + to_ego[:3, 3]
    road = (np.abs(in_ego[:, 1] - 1.75) < 2.5) & (np.abs(in_ego[:, 0]) < 15.0)
    assert road.sum() > 1000
    assert np.abs(np.median(in_ego[road, 2])) < 0.01


def test_the_range_noise_is_two_centimetres(standing):
    a, b = (standing.sweep(LIDAR, time) for time in (0, 500_000))
    by_beam = [
        {
            (int(p[4]), round(float(np.arctan2(p[1], p[0])) / (2 * np.pi) * 10850)): float(np.linalg.norm(p[:3]))
            for p in s
        }
        for s in (a.astype(np.float64), b.astype(np.float64))
    ]
    both = by_beam[0].keys() & by_beam[1].keys()
    assert len(both) > 10_000
    difference = np.array([by_beam[0][beam] - by_beam[1][beam] for beam in both])
    assert difference.std() == pytest.approx(0.02 * np.sqrt(2), rel=0.05)
    assert abs(difference.mean()) < 0.001


def test_noise_differs_between_sweeps_and_is_reproducible(standing):
    first, again, later = (standing.sweep(LIDAR, time) for time in (0, 0, 50_000))
    np.testing.assert_array_equal(first, again)
    assert len(first) != len(later) or not np.array_equal(first, later)


def test_returns_are_listed_ray_by_ray(standing, points):
    """Rows come beam by beam: ring and intensity are those of their ray, the position that of its measured range."""
    found = standing.scan(LIDAR, 0)
    ring, step = np.nonzero(found.returned)
    np.testing.assert_array_equal(points[:, 4], ring)
    np.testing.assert_array_equal(points[:, 3], np.round(255 * found.intensity[ring, step]))
    ranges = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    np.testing.assert_allclose(ranges, found.measured[ring, step], atol=1e-4)
    azimuth = np.arctan2(points[:, 0], points[:, 1])  # clockwise from the sensor's y axis
    np.testing.assert_allclose(np.exp(1j * azimuth), np.exp(1j * (step / 1085 * 2 * np.pi - np.pi)), atol=1e-4)
    objects = found.object[found.returned]
    assert (objects == names_of(standing).index("scenery")).mean() > 0.8
    assert len(np.unique(objects)) > 3, "parked cars return some"


def test_64_beams_are_those_of_an_hdl_64e():
    points = recorder_of(ego="stands", vehicles=0, lidar={"beams": 64}).sweep(LIDAR, 0).astype(np.float64)
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    assert set(np.unique(points[:, 4])) == set(range(64))
    assert np.abs(elevation - (-24.8 + 26.8 / 63 * points[:, 4])).max() < 0.01


@pytest.mark.parametrize(("hz", "steps"), [(20, 1085), (10, 2083)])
def test_a_revolution_ends_at_the_timestamp_and_passes_each_camera_as_it_fires(hz, steps):
    pattern = recorder_of(lidar_hz=hz, lidar={"spins": True}).pattern
    assert pattern.shape == (32, steps) and len(pattern.offsets) == steps
    ends = np.sort(pattern.offsets) * hz
    np.testing.assert_allclose(ends, np.arange(steps) / steps - 1.0, atol=1.0 / steps)
    assert pattern.offsets.max() <= 0.0
    assert not recorder_of(lidar_hz=hz).pattern.offsets.any(), "without spins all leave at the timestamp"
    in_ego = pattern.directions()[16] @ LIDAR.sensor_to_ego[:3, :3].T
    for camera in (sensor for sensor in RIG.values() if sensor.is_camera):
        axis = camera.sensor_to_ego[:2, 2] / np.linalg.norm(camera.sensor_to_ego[:2, 2])
        passing = pattern.offsets[np.argmax(in_ego[:, :2] @ axis)]
        late = (passing * hz - camera.delay_us * 1e-6 * 20 + 0.5) % 1.0 - 0.5
        assert abs(late) < 0.06, f"{camera.channel}: {late:.3f} of a revolution"


def test_between_key_frames_the_lidar_turns_at_its_rate():
    times = trigger_times(LIDAR, world_of(key_frames=3, sweeps=("LIDAR_TOP",)))
    assert [time for time, _, _ in times] == list(range(0, 1_000_001, 50_000))
    assert [index for _, _, index in times] == [0] + [1] * 10 + [2] * 10
    assert [time for time, is_key, _ in times if is_key] == [0, 500_000, 1_000_000]
    assert trigger_times(LIDAR, world_of(key_frames=3)) == [(0, True, 0), (500_000, True, 1), (1_000_000, True, 2)]
    dense = world_of(key_frames=3, key_frame_hz=10, image_hz=10, lidar_hz=20, sweeps=("LIDAR_TOP",))
    assert [time for time, _, _ in trigger_times(LIDAR, dense)] == [0, 50_000, 100_000, 150_000, 200_000]
