"""Sweeps that are not motion-compensated: moved by the ego path, and compared with an analytic motion."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import drives
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.corrections import Corrections, apply_corrections
from drivesplat.readers.drive.faults import faults_of
from drivesplat.readers.drive.format import read_drive
from drivesplat.readers.drive.reader import read
from drivesplat.readers.drive.reader import scene_of as drive_scene
from drivesplat.readers.sweeps import read_returns, sweep_fault
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scene import Scene, read_scene, write_scene

SPEED, YAW_RATE = 12.0, 0.4
"""Metres and radians per second."""
BEGIN = 1_700_000_000_000_000
SWEEPS = (BEGIN + 200_000, BEGIN + 300_000)
MOUNT = rigid(Rotation.from_euler("xyz", [0.02, -0.05, 1.5]).as_matrix(), np.array([1.2, -0.4, 1.8]))
SOURCE = drives.source(dataset="", reader="drive", version="", scene="it", cameras=(), sweeps=False)


def ego_at(seconds: float) -> np.ndarray:
    """Ego to world (4, 4) on a circle at constant speed, with the height of a ramp."""
    heading, radius = YAW_RATE * seconds, SPEED / YAW_RATE
    place = [radius * np.sin(heading), radius * (1.0 - np.cos(heading)), 0.3 * seconds]
    return rigid(Rotation.from_euler("z", heading).as_matrix(), np.array(place))


def pose_record(pose: np.ndarray) -> dict[str, Any]:
    return {"translation": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}


def offsets(count: int = 500) -> np.ndarray:
    """Times of points, half a revolution of 0.1 s before the sweep's timestamp to half a revolution after it."""
    return np.linspace(-0.05, 0.05, count)


def seen(time: int) -> tuple[np.ndarray, np.ndarray]:
    """Static points (n, 3) in the sensor's frame at the sweep's time, and each in its frame at its own time."""
    at_sweep = np.random.default_rng(time).uniform([-40, -40, -2], [40, 40, 5], (500, 3))
    now = (time - BEGIN) * 1e-6
    world = apply(ego_at(now) @ MOUNT, at_sweep)
    own = [apply(inverse(ego_at(now + t) @ MOUNT), p[None])[0] for t, p in zip(offsets(), world, strict=True)]
    return at_sweep, np.array(own)


def write(folder: Path, step_us: int = 10_000, times: np.ndarray | None = None, **changes: Any) -> Path:
    """A drive of LiDAR alone whose sweeps are not compensated, with ego poses every `step_us`."""
    sweeps = []
    for time in SWEEPS:
        columns = dict(zip("xyz", seen(time)[1].T, strict=True))
        np.savez(folder / f"{time}.npz", **columns, time=offsets() if times is None else times)
        sweeps.append({"lidar": "top", "timestamp": time, "file": f"{time}.npz"})
    ego_poses = [
        {"timestamp": time, **pose_record(ego_at((time - BEGIN) * 1e-6))}
        for time in range(BEGIN, BEGIN + 500_001, step_us)
    ]
    lidar = {"sensor_to_ego": pose_record(MOUNT), "motion_compensated": False, "revolution_s": 0.1}
    record = {
        "format": "drivesplat drive", "version": 1, "lidars": {"top": lidar}, "ego_poses": ego_poses, "sweeps": sweeps,
        **changes,
    }  # fmt: skip
    (folder / "drive.json").write_text(json.dumps(record), encoding="utf-8")
    return folder


def scene_of(folder: Path) -> Scene:
    return read(folder, SOURCE)


@pytest.mark.parametrize(("step_us", "error"), [(1_000, 2e-5), (10_000, 1e-4), (100_000, 0.02)])
def test_points_are_where_they_would_have_been_seen_at_the_timestamp(step_us, error, tmp_path):
    """Within the error of a straight line between two ego poses, a dt^2 / 8: 6 mm at 10 Hz and 4.8 m/s^2."""
    for sweep in scene_of(write(tmp_path, step_us)).sweeps:
        expected, raw = seen(sweep.timestamp)
        points = read_returns(sweep).points
        assert np.linalg.norm(raw - expected, axis=1).max() > 0.5
        assert np.linalg.norm(points - expected, axis=1).max() < error
        np.testing.assert_allclose(read_returns(sweep).offsets_s, offsets(), atol=1e-12)


def test_without_the_key_points_stay_and_a_sweep_with_its_own_pose_is_moved_by_the_ego_path(tmp_path):
    lidar = {"sensor_to_ego": pose_record(MOUNT)}
    for sweep in scene_of(write(tmp_path, lidars={"top": lidar})).sweeps:
        assert sweep.motion is None
        np.testing.assert_array_equal(read_returns(sweep).points, seen(sweep.timestamp)[1])
    elsewhere, time = rigid(np.eye(3), np.array([5.0, 6.0, 7.0])), SWEEPS[0]
    sweeps = [{"lidar": "top", "timestamp": time, "file": f"{time}.npz", "lidar_to_world": pose_record(elsewhere)}]
    (sweep,) = scene_of(write(tmp_path, sweeps=sweeps, origin=[0.0, 0.0, 0.0])).sweeps
    np.testing.assert_array_equal(sweep.sensor_to_world, elsewhere)
    assert np.abs(read_returns(sweep).points - seen(time)[0]).max() < 1e-4
    (fault,) = faults_of(read_drive(write(tmp_path, ego_poses=[], sweeps=sweeps)))
    assert fault.startswith("lidars.top: motion_compensated is false, but there are no ego_poses")


def test_times_beyond_the_known_motion_are_a_fault(tmp_path):
    for times, words in (
        (offsets() * 1e6, "check the unit of time, ego_poses and the LiDAR's revolution_s"),
        (
            offsets() - 0.07,
            "has points at -0.12 to -0.02 s after its timestamp, and the vehicle's motion is known from",
        ),
    ):
        sweep, _ = scene_of(write(tmp_path, times=times)).sweeps
        fault = sweep_fault(sweep)
        assert fault and words in fault and str(SWEEPS[0]) in fault and "\n" not in fault


def poses_at(*times: int) -> list[dict[str, Any]]:
    return [{"timestamp": t, **pose_record(ego_at((t - BEGIN) * 1e-6))} for t in times]


def test_at_the_ends_of_ego_poses_the_motion_continues_over_half_a_scan(tmp_path, caplog):
    """As with poses at the scans' own times: within a (dt^2 / 2 + dt T / 2) = 18 mm at 4.8 m/s^2, 0.05 and 0.1 s."""
    scene = scene_of(write(tmp_path, ego_poses=poses_at(*SWEEPS)))
    assert [sweep.timestamp for sweep in scene.sweeps] == list(SWEEPS) and not caplog.records
    for sweep in scene.sweeps:
        expected, raw = seen(sweep.timestamp)
        assert np.linalg.norm(raw - expected, axis=1).max() > 0.5
        assert np.linalg.norm(read_returns(sweep).points - expected, axis=1).max() < 0.06  # turned at 40 m by 0.02 rad
        assert np.median(np.linalg.norm(read_returns(sweep).points - expected, axis=1)) < 0.012


@pytest.mark.parametrize(
    ("ego_poses", "times", "kept"),
    [
        (poses_at(*SWEEPS), offsets() + 0.05, SWEEPS[:1]),  # the last one ends 0.1 s after the last pose
        (poses_at(*SWEEPS), offsets() - 0.05, SWEEPS[1:]),
        (poses_at(SWEEPS[0] - 1_000_001, *SWEEPS), offsets() - 0.05, SWEEPS[1:]),  # more than a second is a guess
        (poses_at(SWEEPS[0], SWEEPS[0] + 20_000, *range(SWEEPS[1], SWEEPS[1] + 90_000, 20_000)), offsets(), SWEEPS[1:]),
    ],
)
def test_a_sweep_that_reaches_farther_is_left_out_with_a_warning(ego_poses, times, kept, tmp_path, caplog):
    scene = scene_of(write(tmp_path, ego_poses=ego_poses, times=times))
    assert [sweep.timestamp for sweep in scene.sweeps] == list(kept)
    assert all(sweep_fault(sweep) is None for sweep in scene.sweeps)
    (left,) = [record.getMessage() for record in caplog.records]
    assert "the vehicle's motion is known from" in left and left.endswith("; left out")
    assert str({*SWEEPS}.difference(kept).pop()) in left


def test_without_any_poses_sweeps_take_the_motion_that_is_estimated(tmp_path):
    """Until then the vehicle stands, and points are as they were recorded."""
    folder = write(tmp_path, ego_poses=[])
    assert faults_of(read_drive(folder)) == [
        fault for fault in faults_of(read_drive(folder)) if fault.startswith("ego_poses: there is none")
    ]
    standing = drive_scene(read_drive(folder), folder, SOURCE)
    for sweep in standing.sweeps:
        np.testing.assert_allclose(read_returns(sweep).points, seen(sweep.timestamp)[1], atol=1e-9)
    times = np.arange(BEGIN, BEGIN + 500_001, 10_000)
    estimated = np.stack([ego_at((time - BEGIN) * 1e-6) for time in times])
    corrections = Corrections.from_poses(times, np.tile(np.eye(4), (len(times), 1, 1)), estimated)
    scene = apply_corrections(standing, corrections, poses="images")
    write_scene(tmp_path / "scene.json", scene)
    for sweep in read_scene(tmp_path / "scene.json").sweeps:
        np.testing.assert_allclose(sweep.sensor_to_world, ego_at((sweep.timestamp - BEGIN) * 1e-6) @ MOUNT, atol=1e-9)
        assert np.linalg.norm(read_returns(sweep).points - seen(sweep.timestamp)[0], axis=1).max() < 1e-4
