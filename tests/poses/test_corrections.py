"""Pose corrections applied to images, LiDAR sweeps and boxes."""

import dataclasses

import numpy as np
import pytest
from helpers.classed import classed
from helpers.hand_made_views import drive_of, ego_at
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.corrections import Corrections, apply_corrections
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scene import Scene, Sweep, Track, read_scene, write_scene
from drivesplat.scene.splits import frame_groups
from drivesplat.settings.images import HoldoutSettings

TIMES = np.array([100_000, 600_000, 1_100_000])
GIVEN = np.stack([ego_at(time * 1e-6) for time in TIMES])


def correction(turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)) -> np.ndarray:
    """A turn (rotation vector in degrees) and a shift in metres, in the car's frame."""
    return rigid(Rotation.from_rotvec(turn, degrees=True).as_matrix(), np.array(shift))


STEPS = np.stack(
    [
        correction((0.4, 0.0, 0.0), (0.0, 0.02, 0.1)),
        correction((0.0, -0.6, 0.0), (0.03, 0.0, 0.0)),
        correction((0.2, 0.2, 0.1), (0.0, 0.0, -0.2)),
    ]
)
CORRECTIONS = Corrections.from_poses(TIMES, GIVEN, GIVEN @ STEPS)


def vector(transform: np.ndarray) -> np.ndarray:
    """Rotation vector (degrees) and translation (6,)."""
    return np.concatenate([Rotation.from_matrix(transform[:3, :3]).as_rotvec(degrees=True), transform[:3, 3]])


def test_corrections_are_exact_at_images():
    np.testing.assert_allclose(CORRECTIONS.at(TIMES), STEPS, atol=1e-9)
    np.testing.assert_allclose(GIVEN @ CORRECTIONS.at(TIMES), GIVEN @ STEPS, atol=1e-9)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.9])
def test_corrections_are_interpolated_between_images(share):
    (between,) = CORRECTIONS.at(np.array([TIMES[0] + share * 500_000]))
    expected = (1 - share) * vector(STEPS[0]) + share * vector(STEPS[1])
    np.testing.assert_allclose(vector(between), expected, atol=1e-6)
    np.testing.assert_allclose(between[:3, :3] @ between[:3, :3].T, np.eye(3), atol=1e-12)


def test_extrapolation_continues_the_motion_beyond_both_ends():
    """8 m/s ahead, an image every half second and one 10 ms after the last, which is 1 m off: no motion of 100 m/s."""
    times = np.array([0, 500_000, 1_000_000, 1_010_000])
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [0.0, 4.0, 8.0, 9.08]
    still = Corrections.from_poses(times, np.tile(np.eye(4), (4, 1, 1)), poses)
    there = still.extrapolated(500_000.0).at(np.array([-900_000, -250_000, 250_000, 1_260_000]))[:, 0, 3]
    np.testing.assert_allclose(there, [-4.0, -2.0, 2.0, 9.08 + 0.25 * 5.08 / 0.51], atol=1e-6)
    assert still.extrapolated(2_000_000.0) is still


def test_corrections_are_constant_beyond_the_ends():
    early, late = CORRECTIONS.at(np.array([0, 9_000_000]))
    np.testing.assert_allclose([early, late], STEPS[[0, 2]], atol=1e-9)


def test_in_world_moves_objects_placed_by_the_ego_pose():
    """A thing at a place before the given car lies at the same place before the refined one."""
    moved = CORRECTIONS.in_world(TIMES)
    before_the_car = np.array([[12.0, -3.0, 1.0]])
    for given, step, move in zip(GIVEN, STEPS, moved, strict=True):
        np.testing.assert_allclose(apply(move, apply(given, before_the_car)), apply(given @ step, before_the_car),
                                   atol=1e-9)  # fmt: skip


def scene_of() -> Scene:
    """A drive with a sweep at every key frame, a box that drives ahead, and an image between the key frames."""
    drive = drive_of(3)
    times = drive.scene.key_frame_timestamps
    lidar = rigid(np.eye(3), np.array([0.9, 0.0, 1.8]))
    sweeps = tuple(
        Sweep(f"{i}.bin", int(time), ego_at(time * 1e-6) @ lidar, True, i, str(i), "LIDAR_TOP", "nuscenes")
        for i, time in enumerate(times)
    )
    ahead = rigid(Rotation.from_euler("z", 0.3).as_matrix(), np.array([10.0, 1.0, 0.8]))
    boxes = np.stack([ego_at(time * 1e-6) @ ahead for time in times])
    track = Track("it", *classed("vehicle.car"), np.array([4.0, 2.0, 1.6]), times, np.arange(3), boxes, np.full(3, 4))
    first = drive.scene.frames[0]
    mount = inverse(first.ego_to_world) @ first.camera_to_world
    pose = ego_at(0.2)
    between = dataclasses.replace(
        first, timestamp=200_000, ego_to_world=pose, camera_to_world=pose @ mount, is_key_frame=False
    )
    frames = (*drive.scene.frames, between)
    return dataclasses.replace(drive.scene, frames=frames, sweeps=sweeps, tracks=(track,))


SCENE = scene_of()
REFINED = apply_corrections(SCENE, CORRECTIONS)


def test_images_rotate_with_the_ego_vehicle():
    times = np.array([frame.timestamp for frame in SCENE.frames])
    for before, after, delta in zip(SCENE.frames, REFINED.frames, CORRECTIONS.at(times), strict=True):
        np.testing.assert_allclose(after.ego_to_world, before.ego_to_world @ delta, atol=1e-9)
        mounts = [inverse(frame.ego_to_world) @ frame.camera_to_world for frame in (before, after)]
        np.testing.assert_allclose(mounts[1], mounts[0], atol=1e-9)
        for name in ("camera", "timestamp", "image_path", "width", "height", "is_key_frame", "sample_index", "token"):
            assert getattr(after, name) == getattr(before, name)
        np.testing.assert_array_equal(after.intrinsics, before.intrinsics)


def test_sweeps_and_boxes_keep_their_poses_relative_to_the_ego_vehicle():
    """As seen from the car at their times, nothing has moved: neither returns, nor boxes, nor returns in boxes."""
    refined = GIVEN @ STEPS
    for i, (before, after) in enumerate(zip(SCENE.sweeps, REFINED.sweeps, strict=True)):
        np.testing.assert_allclose(
            inverse(refined[i]) @ after.sensor_to_world, inverse(GIVEN[i]) @ before.sensor_to_world, atol=1e-9
        )
        in_lidar = [
            inverse(sweep.sensor_to_world) @ scene.tracks[0].object_to_world[i]
            for sweep, scene in ((before, SCENE), (after, REFINED))
        ]
        np.testing.assert_allclose(in_lidar[1], in_lidar[0], atol=1e-9)
    for given, now, box, moved in zip(GIVEN, refined, SCENE.tracks[0].object_to_world,
                                      REFINED.tracks[0].object_to_world, strict=True):  # fmt: skip
        distances = [np.linalg.norm(pose[:3, 3] - ego[:3, 3]) for ego, pose in ((given, box), (now, moved))]
        assert distances[1] == pytest.approx(distances[0], abs=1e-9)
        assert not np.allclose(box, moved, atol=1e-3)


def test_only_poses_of_the_scene_change_and_their_source_is_recorded(tmp_path):
    assert REFINED.poses == "refined" and SCENE.poses == "nuscenes"
    same = ("name", "dataset", "version", "key_frame_range", "missing_images", "provenance")
    assert all(getattr(REFINED, name) == getattr(SCENE, name) for name in same)
    np.testing.assert_array_equal(REFINED.key_frame_timestamps, SCENE.key_frame_timestamps)
    write_scene(tmp_path / "scene_refined.json", REFINED)
    again = read_scene(tmp_path / "scene_refined.json")
    np.testing.assert_array_equal(again.frames[1].camera_to_world, REFINED.frames[1].camera_to_world)
    holdout = HoldoutSettings(every_nth=0, last_block=1)
    assert frame_groups(again, holdout) == frame_groups(SCENE, holdout)


def test_identity_corrections_change_nothing():
    same = apply_corrections(SCENE, Corrections.from_poses(TIMES, GIVEN, GIVEN))
    np.testing.assert_allclose(same.frames[2].camera_to_world, SCENE.frames[2].camera_to_world, atol=1e-9)
    np.testing.assert_allclose(same.tracks[0].object_to_world, SCENE.tracks[0].object_to_world, atol=1e-9)
