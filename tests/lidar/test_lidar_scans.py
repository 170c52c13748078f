"""Scans rebuilt from returns, against the demo world's own rays and against patterns made by hand."""

import doctest
from dataclasses import replace

import numpy as np
import pytest
from helpers.demo_worlds import LIDAR, recorder_of
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.lidar import scans
from drivesplat.lidar.scans import Spin, mean_velocity, scan_of, sensor_poses, wrapped
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scan import Scan
from drivesplat.scene.scene import Sweep
from drivesplat.scene.sensors import Lidar, LidarReturns, SweepMotion
from drivesplat.world.optics.lidar import FORWARD

TIME_US = 2_000_000
REVOLUTION_US = 50_000


def standing(offsets: np.ndarray) -> np.ndarray:
    return np.tile(np.eye(4), (len(offsets), 1, 1))


def sweep_at(timestamp: int, sensor_to_world: np.ndarray, motion: SweepMotion | None = None) -> Sweep:
    return Sweep("", timestamp, sensor_to_world, True, 0, "", "top", "nuscenes", motion)


@pytest.fixture(scope="module")
def recorder():
    """A car that turns a corner, with a LiDAR that spins."""
    return recorder_of(lidar={"spins": True}, bend_deg=35.0)


@pytest.fixture(scope="module")
def rebuilt(recorder) -> Scan:
    """The scan of a file as nuScenes writes it: compensated points with rings, without times."""
    rows = recorder.sweep(LIDAR, TIME_US).astype(np.float64)
    times = TIME_US + REVOLUTION_US * np.arange(-2, 2)
    poses = recorder.ego_to_street(times * 1e-6) @ LIDAR.sensor_to_ego
    sweeps = [sweep_at(int(time), pose) for time, pose in zip(times, poses, strict=True)]
    returns = LidarReturns(rows[:, :3], (rows[:, 3] / 255.0).astype(np.float32), rows[:, 4].astype(np.int64))
    lidar = Lidar("top", recorder.pattern.elevations, len(recorder.pattern.azimuths))
    spin = Spin(REVOLUTION_US * 1e-6, -REVOLUTION_US * 1e-6, 0.5 * np.pi + 2.0 * np.pi * FORWARD)
    return scan_of(returns, lidar, sensor_poses(sweeps[2], sweeps), spin)


def test_the_demo_worlds_rays_are_rebuilt(recorder, rebuilt):
    """Directions, times, ranges, intensities and holes of every ray, while the car drives round a bend."""
    truth, pattern = recorder.scan(LIDAR, TIME_US), recorder.pattern
    azimuths = 0.5 * np.pi - pattern.azimuths  # the demo's are clockwise from the y axis
    mean = np.angle(np.exp(1j * rebuilt.rays.azimuths.astype(np.float64)).mean(axis=0))
    columns = np.abs(wrapped(mean - azimuths[:, None])).argmin(axis=1)
    assert rebuilt.rays.shape == pattern.shape and len(set(columns)) == len(columns)
    np.testing.assert_array_equal(rebuilt.returned[:, columns], truth.returned)
    np.testing.assert_allclose(wrapped(rebuilt.rays.azimuths[:, columns] - azimuths), 0.0, atol=1e-4)
    np.testing.assert_allclose(rebuilt.rays.elevations[:, columns] - pattern.elevations[:, None], 0.0, atol=1e-4)
    np.testing.assert_allclose(rebuilt.rays.offsets_s[:, columns] - pattern.offsets, 0.0, atol=1e-6)
    for found, expected in ((rebuilt.ranges, truth.measured), (rebuilt.intensities, truth.intensity)):
        expected = np.where(truth.returned, expected, 0.0)
        np.testing.assert_allclose(found[:, columns], expected, atol=2e-3)


def pattern_returns(beams: np.ndarray, steps: int, shifts: np.ndarray, keep: np.ndarray) -> LidarReturns:
    """Returns at 10 m + ring of the rays where `keep` (b, steps), each ring shifted in azimuth."""
    rings, columns = np.nonzero(keep)
    azimuths = -np.pi + (columns + shifts[rings]) * 2.0 * np.pi / steps
    flat = np.cos(beams[rings])
    directions = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), np.sin(beams[rings])], axis=-1)
    return LidarReturns((10.0 + rings[:, None]) * directions, rings=rings.astype(np.int64))


BEAMS = np.radians([-20.0, -9.0, -4.0, 1.0, 8.0])
KEEP = np.random.default_rng(0).random((5, 90)) < 0.7
SHIFTS = np.array([0.0, 0.3, -0.4, 0.1, 0.45])


@pytest.mark.parametrize("steps", [90, None])
@pytest.mark.parametrize("rings", [True, False])
@pytest.mark.parametrize("elevations", [True, False])
def test_rings_steps_and_elevations_are_found_where_they_are_unknown(steps, rings, elevations):
    returns = pattern_returns(BEAMS, 90, SHIFTS, KEEP)
    lidar = Lidar("top", BEAMS if elevations else None, steps)
    if not rings:
        returns = replace(returns, rings=None)
    if not rings and not elevations:
        with pytest.raises(DatasetError, match="LiDAR top: its returns have no rings and its beam_elevations"):
            scan_of(returns, lidar, standing)
        return
    scan = scan_of(returns, lidar, standing)
    assert scan.rays.shape == (5, 90)
    np.testing.assert_array_equal(scan.returned.sum(axis=1), KEEP.sum(axis=1))
    np.testing.assert_allclose(scan.ranges, np.where(scan.returned, 10.0 + np.arange(5)[:, None], 0.0), atol=1e-5)
    np.testing.assert_allclose(scan.rays.elevations, np.tile(BEAMS[:, None], 90), atol=1e-5)
    steps_of = np.diff(np.unwrap(scan.rays.azimuths.astype(np.float64)), axis=1)
    np.testing.assert_allclose(steps_of, 2.0 * np.pi / 90, atol=1e-5)


def test_more_rings_than_beam_elevations_are_measured():
    """As in a file of another sensor than the one that its table describes."""
    scan = scan_of(pattern_returns(BEAMS, 90, SHIFTS, KEEP), Lidar("top", BEAMS[:3], 90), standing)
    np.testing.assert_allclose(scan.rays.elevations, np.tile(BEAMS[:, None], 90), atol=1e-5)


def rosette(count: int = 3000) -> LidarReturns:
    """The returns of a LiDAR without beams, anywhere between -30 and 10 degrees."""
    random = np.random.default_rng(3)
    azimuths, elevations = random.uniform(-np.pi, np.pi, count), random.uniform(*np.radians([-30.0, 10.0]), count)
    flat = np.cos(elevations)
    directions = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), np.sin(elevations)], axis=1)
    return LidarReturns(20.0 * directions)


MANY = np.radians(np.linspace(-30.67, 10.67, 32))
ALL = np.ones((32, 90), dtype=bool)


def test_beams_on_which_returns_do_not_lie_are_refused():
    for returns in (rosette(), replace(pattern_returns(MANY + 0.011, 90, np.zeros(32), ALL), rings=None)):
        with pytest.raises(DatasetError, match="LiDAR top: its returns do not lie on its beam_elevations: "):
            scan_of(returns, Lidar("top", MANY, 90), standing)


@pytest.mark.parametrize("known", [MANY[::-1], MANY - 0.1, np.radians(np.linspace(-25.0, 15.0, 40))])
def test_beams_of_another_sensor_than_the_rings_are_measured(known):
    scan = scan_of(
        pattern_returns(MANY, 90, np.zeros(32), ALL & (np.arange(90) % 9 > 0)), Lidar("top", known, 90), standing
    )
    assert scan.rays.shape == (len(known), 90) and (~scan.returned[:32]).sum() == 320
    np.testing.assert_allclose(scan.rays.elevations[:32], np.tile(MANY[:, None], 90), atol=1e-5)  # also of holes


def test_the_motion_of_the_sensor_is_that_between_sweeps_and_extrapolated():
    def pose(seconds: float) -> np.ndarray:
        return rigid(Rotation.from_euler("z", 0.4 * seconds + 1.0).as_matrix(), np.array([8.0 * seconds, 3.0, 1.0]))

    times = (900_000, 1_000_000, 1_100_000)
    sweeps = [sweep_at(time, pose(time * 1e-6)) for time in times]
    offsets = np.array([-0.35, -0.07, 0.0, 0.04, 0.2])
    expected = np.stack([inverse(pose(1.0)) @ pose(1.0 + offset) for offset in offsets])
    poses = sensor_poses(sweeps[1], sweeps)
    np.testing.assert_allclose(poses(offsets), expected, atol=1e-12)
    linear, angular = mean_velocity(poses, -0.1, 0.0)
    np.testing.assert_allclose(linear, 8.0 * np.array([np.cos(1.4), -np.sin(1.4), 0.0]), atol=1e-9)
    np.testing.assert_allclose(angular, [0.0, 0.0, 0.4], atol=1e-9)
    alone = sensor_poses(sweeps[1], sweeps[1:2])
    np.testing.assert_allclose(alone(offsets), standing(offsets), atol=1e-12)
    assert not np.any(mean_velocity(alone, 0.0, 0.0))


def test_the_motion_of_a_sweep_is_used_where_the_dataset_gives_it():
    mount = rigid(Rotation.from_euler("z", 0.5).as_matrix(), np.array([1.0, 0.0, 2.0]))
    ego = np.stack([inverse(mount), rigid(np.eye(3), np.array([2.0, 0.0, 0.0])) @ inverse(mount)])
    motion = SweepMotion(np.array([0.0, 0.1]), ego, mount)
    found = sensor_poses(sweep_at(0, np.eye(4), motion), [])(np.array([0.0, 0.05]))
    np.testing.assert_allclose(found[:, :3, 3], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], atol=1e-12)


def test_points_at_their_own_times_are_the_returns():
    """Of a sensor that drives and turns: each point of the scan, moved to the timestamp, is a return."""
    returns = pattern_returns(BEAMS, 90, SHIFTS, KEEP)
    spin = Spin(0.1, -0.1, 2.0, clockwise=False)
    end = rigid(Rotation.from_euler("z", 0.05).as_matrix(), np.array([2.0, 0.0, 0.0]))
    poses = sensor_poses(sweep_at(100_000, end), [sweep_at(0, np.eye(4))])
    scan = scan_of(returns, Lidar("top", BEAMS, 90), poses, spin)
    offsets = scan.rays.offsets_s[scan.returned].astype(np.float64)
    fraction = spin.fractions(scan.rays.azimuths[scan.returned].astype(np.float64))
    inner = np.abs(fraction - 0.5) < 0.45
    np.testing.assert_allclose(offsets[inner], -0.1 + 0.1 * fraction[inner], atol=1e-6)
    pairs = zip(poses(offsets), scan.points(), strict=True)
    moved = np.concatenate([apply(pose, point[None]) for pose, point in pairs])
    distances = np.linalg.norm(moved[:, None] - returns.points[None], axis=2).min(axis=1)
    assert distances.max() < 1e-4


def test_the_example_runs():
    (example,) = doctest.DocTestFinder(recurse=False).find(scan_of, "scan_of", module=scans, globs={})
    assert len(example.examples) > 5
    assert doctest.DocTestRunner().run(example).failed == 0
