"""Poses corrected by LiDAR: a street of planes, of which each sweep sees its surroundings."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.from_sweeps import align_sweeps, pairs_of
from drivesplat.preprocess.poses.refinement import refine_or_keep
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scene import Scene, Sweep
from drivesplat.settings.refine_poses import RefinePosesJob

JOB = RefinePosesJob.model_validate(
    {"refine_poses": {}, "random_seed": 0, "lidar": {"ray_spacing": (0.4, 0.4), "own_car_radius": 0.0}}
)
MOUNT = rigid(Rotation.from_euler("z", -90, degrees=True).as_matrix(), np.array([1.0, 0.0, 1.8]))
"""Sensor to vehicle, turned as that of nuScenes."""
SPACING, VIEW = 0.3, 20.0
"""Metres between points of a surface, and from the sensor to the farthest ones."""
COUNT = 10
STEPS = np.arange(COUNT)


def patch(corner: list[float], along: list[float], up: list[float]) -> np.ndarray:
    """Points (n, 3) of a rectangle."""
    sides = [np.array(side, dtype=float) for side in (along, up)]
    grid = [np.arange(0.0, np.linalg.norm(side), SPACING) for side in sides]
    directions = [side / np.linalg.norm(side) for side in sides]
    a, b = (values.ravel() for values in np.meshgrid(*grid))
    return np.array(corner) + a[:, None] * directions[0] + b[:, None] * directions[1]


def street(recesses: bool = True) -> np.ndarray:
    """The road, two facades, and every 6 m a recess 2 m deep, without which it is a tunnel."""
    parts = [patch([-30, -9, 0], [100, 0, 0], [0, 18, 0])]
    for side in (-9.0, 9.0):
        parts.append(patch([-30, side, 0], [100, 0, 0], [0, 0, 5]))
        if recesses:
            parts += [patch([x, side, 0], [0, 2.0 * np.sign(side), 0], [0, 0, 5]) for x in range(-30, 70, 6)]
    return np.concatenate(parts)


def recorded(folder: Path, given: np.ndarray, truth: np.ndarray, points: np.ndarray) -> Scene:
    """Sweeps at vehicle poses `truth` (n, 4, 4), with `given` ones."""
    random, sweeps = np.random.default_rng(0), []
    for i, (pose, stated) in enumerate(zip(truth, given, strict=True)):
        in_sensor = apply(inverse(pose @ MOUNT), points)
        in_sensor = in_sensor[np.linalg.norm(in_sensor, axis=1) < VIEW]
        x, y, z = (in_sensor + random.normal(0.0, 0.01, in_sensor.shape)).T
        path = folder / f"{i}.npz"
        np.savez(path, x=x, y=y, z=z)
        sweeps.append(Sweep(str(path), i * 200_000, stated @ MOUNT, True, i, str(i), "top", "drive"))
    times = np.arange(len(truth)) * 200_000
    return Scene("s", "d", "v", "", np.zeros(3), times, (), tuple(sweeps), (), "drive", 5.0)


def path_of(step: float = 1.0) -> np.ndarray:
    """Vehicle poses along a slight bend."""
    turns = Rotation.from_rotvec(np.radians(0.3) * STEPS[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    return rigid(turns, np.stack([step * STEPS, 0.02 * STEPS, np.zeros(COUNT)], axis=1))


def wander(poses: np.ndarray, metres: float, degrees: float) -> np.ndarray:
    """Poses with an error that changes slowly, as that of satellite positions."""
    phase = 2 * np.pi * np.arange(len(poses)) / len(poses)
    turns = Rotation.from_euler("xyz", degrees * np.stack([np.sin(phase), np.cos(phase), np.sin(2 * phase)], axis=1),
                                degrees=True)  # fmt: skip
    return poses @ rigid(turns.as_matrix(), metres * np.stack([np.sin(phase), np.cos(phase), np.sin(phase)], axis=1))


def steps_of(scene: Scene) -> np.ndarray:
    """The motion (n - 1, 4, 4) of the sensor from sweep to sweep."""
    poses = np.stack([sweep.sensor_to_world for sweep in scene.sweeps])
    return inverse(poses[:-1]) @ poses[1:]


def errors(scene: Scene, truth: np.ndarray) -> np.ndarray:
    """Errors (n - 1,) in metres of the position of each sweep in the frame of the one before."""
    return np.linalg.norm((steps_of(scene) - inverse(truth[:-1] @ MOUNT) @ truth[1:] @ MOUNT)[:, :3, 3], axis=1)


def jumping(poses: np.ndarray) -> np.ndarray:
    moved = poses.copy()
    moved[COUNT // 2 :, :3, 3] += [0.4, 0.3, 0.0]
    return moved


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda poses: wander(poses, 0.4, 0.6), id="wander", marks=pytest.mark.slow),
        pytest.param(jumping, id="jump"),
    ],
)
def test_wrong_poses_are_corrected_to_centimetres(tmp_path, spoil):
    truth = path_of()
    scene = recorded(tmp_path, spoil(truth), truth, street())
    aligned = align_sweeps(scene, JOB, threads=2)
    assert aligned.record["taken"] and aligned.record["sweeps"] == COUNT
    assert aligned.record["after_m"] < 0.5 * aligned.record["before_m"]
    assert aligned.record["shift_m"]["largest"] > 0.1
    assert errors(scene, truth).max() > 0.1 and errors(aligned.scene, truth).max() < 0.04
    assert aligned.scene.poses == "refined"


def test_exact_poses_stay(tmp_path):
    truth = path_of()
    aligned = align_sweeps(scene := recorded(tmp_path, truth, truth, street()), JOB)
    assert not aligned.record["taken"] and aligned.scene is scene


def test_a_tunnel_leaves_the_recorded_motion_along_it(tmp_path):
    """Facades without recesses say nothing about the way along them; lateral errors are corrected."""
    truth = rigid(np.eye(3), np.stack([1.0 * STEPS, np.zeros(COUNT), np.zeros(COUNT)], axis=1))
    given = truth.copy()
    given[:, 1, 3] += 0.3 * np.sin(STEPS)
    aligned = align_sweeps(recorded(tmp_path, given, truth, street(recesses=False)), JOB)
    assert aligned.record["taken"]
    in_vehicle = MOUNT[:3, :3] @ steps_of(aligned.scene)[:, :3, 3].T
    assert np.abs(in_vehicle[0] - 1.0).max() < 0.05 and np.abs(in_vehicle[1]).max() < 0.05


def test_a_standing_vehicle_stays(tmp_path):
    truth = np.tile(np.eye(4), (COUNT, 1, 1))
    aligned = align_sweeps(scene := recorded(tmp_path, truth, truth, street()), JOB)
    assert not aligned.record["taken"] and aligned.scene is scene


def test_sweeps_without_files_or_surfaces_have_no_part_and_two_are_too_few(tmp_path):
    truth = path_of()
    scene = recorded(tmp_path, wander(truth, 0.3, 0.4), truth, street())
    for i in range(3, COUNT, 2):
        Path(scene.sweeps[i].path).unlink()
    noise = np.random.default_rng(1).uniform(-20, 20, (3, 5000))
    np.savez(scene.sweeps[2].path, x=noise[0], y=noise[1], z=noise[2])
    aligned = align_sweeps(scene, JOB)
    assert aligned.record["sweeps"] == COUNT // 2
    assert len({tuple(s.sensor_to_world[:3, 3]) for s in aligned.scene.sweeps} & {
        tuple(s.sensor_to_world[:3, 3]) for s in scene.sweeps}) == 0, "sweeps between are corrected too"  # fmt: skip
    for count in (0, 2):
        few = dataclasses.replace(scene, sweeps=scene.sweeps[:count])
        assert align_sweeps(few, JOB).judge is None and align_sweeps(few, JOB).scene is few


def test_the_judge_objects_to_worse_poses_alone(tmp_path):
    truth = path_of()
    judge = align_sweeps(scene := recorded(tmp_path, truth, truth, street()), JOB).judge
    worse = [
        dataclasses.replace(sweep, sensor_to_world=pose @ MOUNT)
        for sweep, pose in zip(scene.sweeps, wander(truth, 0.1, 0.2), strict=True)
    ]
    spoiled = dataclasses.replace(scene, sweeps=tuple(worse))
    good, bad = judge.distance(scene), judge.distance(spoiled)
    assert bad > 2 * good and "surfaces of LiDAR sweeps lie" in judge.objection(good, bad)
    assert judge.objection(bad, good) is None and judge.objection(good, good) is None
    moved = rigid(Rotation.from_euler("z", 40, degrees=True).as_matrix(), np.array([5.0, 2.0, 1.0]))
    elsewhere = [dataclasses.replace(s, sensor_to_world=moved @ s.sensor_to_world) for s in scene.sweeps]
    whole = dataclasses.replace(scene, sweeps=tuple(elsewhere))
    assert judge.distance(whole) == pytest.approx(judge.distance(scene), rel=1e-6), "the whole drive may lie elsewhere"


def test_a_drive_of_sweeps_alone_is_refined_by_them(tmp_path, caplog):
    truth = path_of()
    refinement = refine_or_keep(recorded(tmp_path, wander(truth, 0.4, 0.6), truth, street()), JOB)
    record = refinement.record
    assert record["refined"] and record["kept_because"] is None and record["lidar"]["taken"]
    assert record["images"] is None and refinement.scene.poses == "refined"
    assert errors(refinement.scene, truth).max() < 0.04 and len(refinement.points.points) == 0
    kept = refine_or_keep(recorded(tmp_path, truth, truth, street()), JOB).record
    assert not kept["refined"] and "fit each other no better" in kept["kept_because"]


def test_fitted_and_withheld_pairs_share_none():
    for step, count in ((1.0, 16), (5.0, 6), (0.0, 8), (0.3, 3)):
        poses = rigid(np.eye(3), np.stack([step * np.arange(count)] + [np.zeros(count)] * 2, axis=1))
        fitted, withheld = pairs_of(poses)
        assert withheld and not set(fitted) & set(withheld)
        assert {i for pair in fitted for i in pair} == set(range(count)), "every sweep is tied to another"
    assert pairs_of(np.tile(np.eye(4), (2, 1, 1))) == ([(0, 1)], [])
