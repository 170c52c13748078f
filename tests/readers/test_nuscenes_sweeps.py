"""nuScenes' LiDAR files: rays in the order in which they were fired, or returns alone."""

import numpy as np
import pytest

from drivesplat.errors import DatasetError
from drivesplat.lidar.scans import scan_of
from drivesplat.readers.checks import checked_spin
from drivesplat.readers.nuscenes.reader import AZIMUTH_STEPS, BEAM_ELEVATIONS, SPIN
from drivesplat.readers.nuscenes.sweep_file import BEAMS, FIRING_S, read_file
from drivesplat.scene.rigid import rigid
from drivesplat.scene.sensors import Lidar, Spin

FIRINGS = 1084
SPEED = np.array([0.0, 9.0, 0.0])
"""Forward is y."""


def fired(hit: np.ndarray) -> np.ndarray:
    """The points of a file, of a room of 10 m around a sensor that drives: rays that do not `hit` (firings, beams) have
    the range 0; compensated to the end of the revolution."""
    turn = np.pi - 2.0 * np.pi * np.arange(FIRINGS)[:, None] / FIRINGS
    up = BEAM_ELEVATIONS[None]
    rays = np.stack(np.broadcast_arrays(np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)), axis=-1)
    offsets = FIRING_S * np.arange(1 - FIRINGS, 1)
    points = rays * np.where(hit, 10.0, 0.0)[..., None] + offsets[:, None, None] * SPEED
    rings = np.broadcast_to(np.arange(BEAMS), hit.shape)
    return np.dstack([points, np.full(hit.shape, 51.0), rings]).reshape(-1, 5).astype(np.float32)


def driving(offsets: np.ndarray) -> np.ndarray:
    return rigid(np.tile(np.eye(3), (len(offsets), 1, 1)), offsets[:, None] * SPEED)


@pytest.fixture
def hit() -> np.ndarray:
    return np.random.default_rng(0).uniform(size=(FIRINGS, BEAMS)) > 0.13


def test_rays_in_the_order_of_firing_have_their_times_and_those_of_range_0_are_holes(tmp_path, hit):
    path = tmp_path / "a.pcd.bin"
    fired(hit).tofile(path)
    returns = read_file(path)
    assert returns.offsets_s is not None
    np.testing.assert_allclose(
        returns.offsets_s[[0, 31, 32, -1]], [-1083 * FIRING_S, -1083 * FIRING_S, -1082 * FIRING_S, 0]
    )
    scan = scan_of(returns, Lidar("top", BEAM_ELEVATIONS, FIRINGS, SPIN), driving, SPIN)
    assert scan.returned.sum() == hit.sum()
    np.testing.assert_allclose(scan.ranges[scan.returned], 10.0, atol=1e-3)
    np.testing.assert_allclose(np.ptp(scan.rays.elevations, axis=1), 0.0, atol=1e-4)
    still = scan_of(returns, Lidar("top", BEAM_ELEVATIONS, FIRINGS), lambda o: np.tile(np.eye(4), (len(o), 1, 1)))
    assert np.ptp(still.ranges[still.returned]) > 0.4, "the motion matters"
    np.testing.assert_allclose(returns.intensity, 0.2, rtol=1e-6)


def test_points_that_are_not_finite_keep_the_times_of_the_others(tmp_path, hit):
    points = fired(hit)
    points[40, 0] = np.nan
    points.tofile(tmp_path / "a.pcd.bin")
    returns = read_file(tmp_path / "a.pcd.bin")
    assert len(returns.points) == FIRINGS * BEAMS - 1 and returns.offsets_s is not None
    np.testing.assert_allclose(returns.offsets_s[[39, 40, 62, 63]], FIRING_S * np.array([-1082, -1082, -1082, -1081]))


def test_returns_in_another_order_have_no_times(tmp_path, hit):
    points = fired(hit)
    for other in (points[hit.ravel()], points[np.argsort(points[:, 4], kind="stable")], points[:BEAMS]):
        other.tofile(tmp_path / "a.pcd.bin")
        assert read_file(tmp_path / "a.pcd.bin").offsets_s is None


def test_the_spin_of_the_dataset_gives_the_times_of_the_order(tmp_path, hit):
    """Returns alone, whose times follow from where they are: those of the files in the order of firing."""
    points = fired(np.ones_like(hit))
    points.tofile(tmp_path / "a.pcd.bin")
    returns = read_file(tmp_path / "a.pcd.bin")
    lidar = Lidar("top", BEAM_ELEVATIONS, FIRINGS, SPIN)
    exact = scan_of(returns, lidar, driving)
    points[np.argsort(points[:, 4], kind="stable")].tofile(tmp_path / "a.pcd.bin")
    found = scan_of(read_file(tmp_path / "a.pcd.bin"), lidar, driving, SPIN)
    both = exact.returned & found.returned
    assert both.mean() > 0.99
    assert np.median(np.abs(exact.rays.offsets_s - found.rays.offsets_s)[both]) < 1e-4
    assert AZIMUTH_STEPS in (1084, 1085)


@pytest.mark.parametrize("values", [None, [0.05, 0.0], [0.0, 0.0, 1.0], [-0.1, 0.0, 1.0], [0.1, 0.0, 99.0], "fast"])
def test_a_spin_that_none_can_be_is_refused_naming_the_record(values):
    with pytest.raises(DatasetError, match="the LiDAR"):
        checked_spin(values, "the LiDAR")


def test_a_spin_is_read():
    assert checked_spin([0.05, -0.05, 3.0], "the LiDAR") == Spin(0.05, -0.05, 3.0, True)
