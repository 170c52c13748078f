"""Matches over longer baselines as the judge of poses, the length of the path, and which images are matched."""

import dataclasses

import numpy as np
import pytest
from helpers.hand_made_views import drive_of
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.corrections import Corrections, apply_corrections
from drivesplat.preprocess.poses.features import later_images
from drivesplat.preprocess.poses.from_matches import MatchJudge, withheld_pairs
from drivesplat.preprocess.poses.refine import path_length, stretched
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import FeatureSettings, LimitSettings, RefinePosesJob

JOB = RefinePosesJob.model_validate({"refine_poses": {"features": {"neighbours": 2, "spacing": 1.0}}, "random_seed": 0})


def straight(step: float, count: int = 12) -> np.ndarray:
    return rigid(np.eye(3), np.stack([step * np.arange(count), np.zeros(count), np.zeros(count)], axis=1))


@pytest.mark.parametrize(
    ("step", "neighbours", "of_the_first"),
    [
        (5.0, 3, [1, 2, 3]),  # 2 Hz, 10 m/s
        (0.5, 3, [1, 5, 10]),  # 5 Hz, 2.5 m/s: 2.5 and 5 m ahead
        (0.0, 3, [1]),  # standing
    ],
)
def test_images_are_matched_by_the_distance_between_them(step, neighbours, of_the_first):
    later = later_images(straight(step), FeatureSettings(neighbours=neighbours))
    assert later[0] == of_the_first
    assert all(i < j < 12 for i, found in enumerate(later) for j in found) and later[-1] == []


def test_withheld_pairs_are_none_that_are_matched():
    images = RigImages.of(drive_of(8).scene, range(8))
    matched = later_images(images.ego_to_world, JOB.refine_poses.features)
    withheld = withheld_pairs(images, JOB)
    assert withheld and not {(i, j) for i, found in enumerate(matched) for j in found} & set(withheld)


def seen(scene: Scene, index: int, points: np.ndarray) -> np.ndarray:
    """World points (n, 3) in an image, homogeneous continuous pixels."""
    frame = scene.frames[index]
    pixels = apply(inverse(frame.camera_to_world), points) @ continuous_intrinsics(frame, (frame.width, frame.height)).T
    return pixels / pixels[:, 2:]


def turned(scene: Scene, degrees: float, stretch: float = 1.0) -> Scene:
    """The scene with every other pose turned upwards, and a path of another length."""
    given = np.stack([frame.ego_to_world for frame in scene.frames])
    refined = given.copy()
    refined[::2] = refined[::2] @ rigid(Rotation.from_euler("y", degrees, degrees=True).as_matrix(), np.zeros(3))
    refined[:, :3, 3] = given[0, :3, 3] + stretch * (given[:, :3, 3] - given[0, :3, 3])
    times = np.array([frame.timestamp for frame in scene.frames])
    return apply_corrections(scene, Corrections.from_poses(times, given, refined))


def test_right_poses_fit_the_matches_and_turned_ones_by_the_angle():
    scene = drive_of(6).scene
    random = np.random.default_rng(0)
    ahead = scene.frames[3].camera_to_world
    points = apply(ahead, np.column_stack([random.uniform(-4, 4, (200, 2)), random.uniform(8, 30, 200)]))
    judge = MatchJudge([(0, 3, seen(scene, 0, points), seen(scene, 3, points))])
    good, bad = judge.distance(scene), judge.distance(turned(scene, 0.5))
    focal = scene.frames[0].intrinsics[1, 1]
    assert good < 1e-6 and 0.1 * focal * np.radians(0.5) < bad < 2 * focal * np.radians(0.5)
    assert judge.objection(good, good) is None
    assert f"is {bad:.2f} pixels with them and 0.00 with the given ones" in judge.objection(good, bad)


@pytest.mark.parametrize(("stretch", "kept"), [(1.005, True), (0.97, False), (1.03, False)])
def test_a_path_of_another_length_is_an_objection(stretch, kept):
    scene = drive_of(8).scene
    reason = stretched(scene, turned(scene, 0.0, stretch), LimitSettings())
    assert (reason is None) is kept
    if reason:
        assert (
            f"the path is {stretch * path_length(scene):.1f} m long, {path_length(scene):.1f} m as recorded" in reason
        )


def test_noise_of_positions_makes_no_path_longer_and_short_paths_are_not_judged():
    scene = drive_of(40).scene
    random = np.random.default_rng(0)
    noisy = [
        dataclasses.replace(frame, ego_to_world=frame.ego_to_world @ rigid(np.eye(3), random.normal(0, 0.02, 3)))
        for frame in scene.frames
    ]
    assert stretched(scene, dataclasses.replace(scene, frames=tuple(noisy)), LimitSettings()) is None
    short = dataclasses.replace(scene, frames=scene.frames[:2])
    assert path_length(short) >= 5.0 or stretched(short, turned(short, 0.0, 1.2), LimitSettings()) is None
