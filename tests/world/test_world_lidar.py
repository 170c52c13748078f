"""The demo world's LiDAR: 32 beams as in nuScenes, range limits, independent noise per sweep."""

import numpy as np
import pytest
from helpers.demo_worlds import LIDAR, RIG, names_of, recorder_of, world_of

from drivesplat.world.optics.rig import trigger_times


def test_returns_are_listed_ray_by_ray_with_noise_of_their_sweep():
    """Rows come beam by beam: ring and intensity are those of their ray, the position that of its measured range. In a
    static street sweeps differ only in noise."""
    standing = recorder_of(ego="stands", vehicles=0, pedestrians=0)
    points, again, later = (standing.sweep(LIDAR, time) for time in (0, 0, 50_000))
    np.testing.assert_array_equal(points, again)
    assert len(points) != len(later) or not np.array_equal(points, later)
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
