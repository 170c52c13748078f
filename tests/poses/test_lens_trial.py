"""A camera whose images contradict its intrinsics is warned of, and no other."""

import dataclasses
import re

import numpy as np
import pytest
from helpers.hand_made_views import Drive, Seen, drive_of, job_of, street_points, views, write_database
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.lens import LensTrial, lens_trial
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import rigid

KEY_FRAMES = 16


def curve(seconds: float) -> np.ndarray:
    """A turn to the left with 20 m radius at 4 m/s."""
    heading = 0.2 * seconds
    place = np.array([20.0 * np.sin(heading), 20.0 * (1.0 - np.cos(heading)), 0.0])
    return rigid(Rotation.from_euler("z", heading).as_matrix(), place)


def straight(seconds: float) -> np.ndarray:
    return rigid(np.eye(3), np.array([4.0 * seconds, 0.0, 0.0]))


def points_around(count: int = 900) -> np.ndarray:
    rng = np.random.default_rng(3)
    angle, radius = rng.uniform(-0.5, 2.5, count), rng.uniform(24.0, 45.0, count)
    return np.stack([radius * np.sin(angle), 20.0 - radius * np.cos(angle), rng.uniform(0.0, 8.0, count)], axis=1)


def bent(drive: Drive, seen: list[Seen], k1: float) -> list[Seen]:
    """The same, seen through a lens with a radial coefficient."""
    k = continuous_intrinsics(drive.scene.frames[0], (drive.scene.frames[0].width, drive.scene.frames[0].height))
    centre, focal = k[:2, 2], k[0, 0]
    moved = []
    for each in seen:
        tangents = (each.pixels - centre) / focal
        radii = np.sum(tangents**2, axis=1, keepdims=True)
        moved.append(dataclasses.replace(each, pixels=centre + focal * tangents * (1.0 + k1 * radii)))
    return moved


def trial_of(folder, path, points, k1: float = 0.0, scale: float = 1.0, of_focal: float = 1.0) -> LensTrial | None:
    """The trial of a drive whose K is `scale` times, and its focal length `of_focal` times the true one."""
    drive = drive_of(KEY_FRAMES, ego_path=path, error=lambda _: np.eye(4))
    images, job = RigImages.of(drive.scene, range(KEY_FRAMES)), job_of(rounds=2, features={"neighbours": 4})
    seen = bent(drive, views(drive, images, points), k1)
    factors = np.array([[scale * of_focal, 1.0, scale], [1.0, scale * of_focal, scale], [1.0, 1.0, 1.0]])
    frames = (dataclasses.replace(f, intrinsics=f.intrinsics * factors) for f in drive.scene.frames)
    stated = RigImages.of(dataclasses.replace(drive.scene, frames=tuple(frames)), range(KEY_FRAMES))
    start = write_database(folder / "features.db", stated, seen, job)
    return lens_trial(stated, start, folder / "features.db", job)


def test_sound_intrinsics_are_not_warned_of(tmp_path):
    trial = trial_of(tmp_path, curve, points_around())
    assert trial is not None and trial.warning() is None
    assert np.allclose([lens.focal for lens in trial.lenses["free"]], trial.stated.focal, rtol=0.02)


def test_a_focal_length_that_straight_motion_leaves_open_is_not_warned_of(tmp_path):
    trial = trial_of(tmp_path, straight, street_points(600))
    assert trial is not None and trial.warning() is None


@pytest.mark.parametrize(
    ("k1", "path", "points"),
    [
        (-0.25, straight, street_points(600)),
        pytest.param(-0.08, straight, street_points(600), marks=pytest.mark.slow),
        pytest.param(0.1, curve, points_around(), marks=pytest.mark.slow),
    ],
)
def test_distortion_that_is_not_stated_is_warned_of_with_its_coefficient(tmp_path, k1, path, points):
    trial = trial_of(tmp_path, path, points, k1=k1)
    assert trial is not None
    sentence = trial.warning()
    found = re.search(r"camera CAM_FRONT look distorted: .* with k1 = (\S+) \((\d+) pixels at the corner\)", sentence)
    assert found and abs(float(found[1]) - k1) < 0.02
    corner = np.hypot(400.0, 225.0) / trial.stated.focal
    assert abs(float(found[2]) - abs(k1) * corner**3 * trial.stated.focal) < 6.0


@pytest.mark.slow
def test_a_matrix_of_another_image_size_is_warned_of_with_the_right_one(tmp_path):
    trial = trial_of(tmp_path, curve, points_around(), scale=1.0 / 0.75)
    sentence = trial.warning()
    focal, x, y = map(float, re.search(r"focal length of (\d+) .* point \((\d+), (\d+)\) instead", sentence).groups())
    true = 0.75 * trial.stated.focal
    assert abs(focal / true - 1.0) < 0.05 and abs(x - 400.0) < 20.0 and abs(y - 225.0) < 20.0
    assert "contradict its camera matrix K" in sentence and "K may belong to another image size" in sentence


def test_a_wrong_focal_length_is_warned_of_where_the_vehicle_turns(tmp_path):
    sentence = trial_of(tmp_path, curve, points_around(), of_focal=0.8).warning()
    assert sentence and "contradict its camera matrix K" in sentence


def test_too_few_points_are_not_judged(tmp_path):
    assert trial_of(tmp_path, curve, points_around(60), k1=-0.25) is None
