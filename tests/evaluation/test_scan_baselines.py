"""Held-out scans from other scans: where their returns are met, and by which rays."""

import numpy as np
import pytest
from helpers.scan_drives import AZIMUTHS, KEY_FRAME_US, STEPS, recorded, room

from drivesplat.evaluation.scan_baselines import fused, measured_points, nearest_scan, neighbouring_scans
from drivesplat.lidar.moved_sensor import sensor_poses_of

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
    np.testing.assert_allclose(
        found.ranges[2, met] * np.cos(AZIMUTHS[met]), 15.0, atol=0.2
    )  # rays are 2.5 degrees apart
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
    first = measured_points(moving)[0]
    local = poses[0, :3, :3] @ (rays.directions()[0, 0] * 12.0) + poses[0, :3, 3]
    np.testing.assert_allclose(first, local, atol=1e-5)
    found = fused([moving], moving)
    assert found.returned.mean() > 0.97, "near the seam, a point may be met a revolution later"
    np.testing.assert_allclose(found.ranges[:, 2:-2], 12.0, atol=1e-5)
    ignored = fused([moving], scan).ranges
    assert np.abs(ignored[ignored > 0] - 12.0).max() > 0.5, "the motion matters"
