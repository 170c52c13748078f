"""Rejection of a refinement: too few points, too large a correction, no gain on withheld points."""

import dataclasses
import logging
import sys

import numpy as np
import pytest
from helpers.hand_made_views import (
    Drive,
    drive_of,
    ego_at,
    job_of,
    street_points,
    views,
    write_database,
)  # fmt: skip
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError, DriveSplatError
from drivesplat.io.storage import canonical_json
from drivesplat.preprocess.poses import refine
from drivesplat.preprocess.poses.adjustment import bundle_adjust, priors_of, triangulate
from drivesplat.preprocess.poses.refine import WithheldTrial, no_gain, refine_from_matches, refine_poses, unusable
from drivesplat.preprocess.poses.refinement import refine_or_keep
from drivesplat.preprocess.poses.refinement_record import Refinement
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.preprocess.poses.triangulated import Observations, TriangulatedPoints
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import LimitSettings

GOOD = WithheldTrial(points=10, observations=50, before=1.5, after=0.4)


def refined_of(folder, drive: Drive, points: int = 400, noise: float = 0.3, **settings) -> Refinement:
    images, job = RigImages.of(drive.scene, range(len(drive.scene.frames))), job_of(**settings)
    seen = views(drive, images, street_points(points), noise)
    start = write_database(folder / "features.db", images, seen, job)
    return refine_from_matches(images, start, folder / "features.db", job)


def flat(seconds: float) -> np.ndarray:
    pose = ego_at(seconds)
    pose[2, 3] = 0.0
    return pose


def exact(seconds: float) -> np.ndarray:
    return np.eye(4)


def seen_of(points: list[int]) -> Observations:
    """What images see, so many points each."""
    image = np.repeat(np.arange(len(points)), points)
    count = max(points, default=0)
    return Observations(
        image, np.concatenate([np.arange(n) for n in points]), np.zeros(len(image)), np.zeros((count, 3)),
        np.arange(count),
    )  # fmt: skip


def moved(image: int, by: np.ndarray, count: int = 4) -> np.ndarray:
    """Corrections (count, 4, 4), of which one is not none."""
    changes = np.tile(np.eye(4), (count, 1, 1))
    changes[image] = by
    return changes


FOUR = RigImages.of(drive_of(4).scene, range(4))
NONE = np.tile(np.eye(4), (4, 1, 1))


def turn(degrees: float, axis: str = "y") -> np.ndarray:
    return rigid(Rotation.from_euler(axis, degrees, degrees=True).as_matrix(), np.zeros(3))


def shift(metres: float) -> np.ndarray:
    return rigid(np.eye(3), np.array([0.0, -metres, 0.0]))


@pytest.mark.parametrize(
    ("points", "changes", "trial", "words"),
    [
        ([30, 30, 30, 30], NONE, GOOD, None),
        ([30, 30, 30, 29], NONE, GOOD, None),
        ([30, 30, 29, 29], NONE, GOOD, "2 of 4 images see 30 triangulated points or more"),
        ([0, 0, 0, 0], NONE, None, "0 of 4 images see 30 triangulated points or more"),
        ([30, 30, 30, 30], moved(2, shift(0.49)), GOOD, None),
        ([30, 30, 30, 30], moved(2, shift(0.52)), GOOD, "moved by 0.52 m, more than 0.5"),
        ([30, 30, 30, 30], moved(1, turn(2.9)), GOOD, None),
        ([30, 30, 30, 30], moved(1, turn(-3.1, "x")), GOOD, "moved by 3.10 degrees, more than 3"),
        ([30, 30, 30, 30], moved(1, np.full((4, 4), np.nan)), GOOD, "moved by nan m"),
        ([30, 30, 30, 30], NONE, dataclasses.replace(GOOD, after=1.5), "is 1.50 pixels with refined"),
        ([30, 30, 30, 30], NONE, dataclasses.replace(GOOD, after=1.43), "a gain of less than 5%"),
        ([30, 30, 30, 30], NONE, dataclasses.replace(GOOD, after=1.42), None),
        ([30, 30, 30, 30], NONE, dataclasses.replace(GOOD, after=np.inf), "is inf pixels"),
    ],
)  # fmt: skip
def test_each_limit_has_its_sentence(points, changes, trial, words):
    if np.isnan(changes).any():
        changes = moved(1, np.block([[np.eye(3), np.full((3, 1), np.nan)], [np.zeros((1, 3)), np.ones((1, 1))]]))
    reason = unusable(FOUR, seen_of(points), changes, trial, LimitSettings()) or no_gain(trial, LimitSettings())
    assert reason is None if words is None else words in reason and "\n" not in reason


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"max_shift": 0.02}, "m, more than 0.02"),
        ({"max_turn": 0.2}, "degrees, more than 0.2"),
        ({"min_points": 400}, "0 of 8 images see 400 triangulated points or more"),
    ],
)
def test_limits_keep_the_given_poses_with_a_warning(tmp_path, caplog, limits, words):
    drive = drive_of(8)
    with caplog.at_level(logging.WARNING):
        refined = refined_of(tmp_path, drive, rounds=1, limits=limits)
    (record,) = caplog.records
    assert words in record.message and "scene made: poses stay as they are" in record.message
    assert refined.record["refined"] is False and words in refined.record["kept_because"]
    assert refined.scene is drive.scene and refined.scene.poses == "nuscenes"
    assert len(refined.points.points) == len(refined.points.seen_by) == 0
    assert refined.record["shift_m"]["largest"] > 0.02, "the rejected corrections are recorded"


def test_the_log_has_the_decision_with_its_figures(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        record = refined_of(tmp_path, drive_of(8), rounds=2).record
    lines = [line.message for line in caplog.records]
    assert [line for line in lines if line.startswith("round ")] == [
        line for line in lines if " points adjusted with 8 images" in line
    ] and sum(line.startswith("round ") for line in lines) == 2
    trial, shift = record["trial"], record["shift_m"]
    (figures,) = [line for line in lines if "of withheld points" in line]
    assert f"with given poses {trial['before_px']:.2f} pixels, and with refined ones {trial['after_px']:.2f}" in figures
    assert f"median shift {shift['median']:.3f} m, largest {shift['largest']:.3f}" in figures
    assert record["refined"] and any("the refined poses are taken" in line for line in lines)


def test_a_correction_beyond_its_limit_names_the_camera_matrix():
    reason = unusable(FOUR, seen_of([30] * 4), moved(1, turn(4.05)), GOOD, LimitSettings())
    assert "4.05 degrees, more than 3" in reason and "a camera matrix K of another image size" in reason


def test_a_refinement_that_only_fits_feature_noise_is_rejected(tmp_path):
    """Exact poses with weak priors, and noisy features: withheld points show it."""
    drive = drive_of(10, ego_path=flat, error=exact)
    refined = refined_of(tmp_path, drive, 150, 2.0, feature_noise=0.05, robust_pixels=5.0, withheld=0.3)
    assert "the error of withheld points is" in refined.record["kept_because"]
    assert refined.record["trial"]["after_px"] > refined.record["trial"]["before_px"] > 0


def test_with_exact_poses_the_points_are_kept(tmp_path):
    drive = drive_of(10, ego_path=flat, error=exact)
    refined = refined_of(tmp_path, drive, rounds=1)
    assert "a gain of less than 5%" in refined.record["kept_because"] and refined.scene is drive.scene
    distance = cKDTree(street_points(400)).query(refined.points.points)[0]
    assert len(refined.points.points) > 100 and np.median(distance) < 0.1


def median_error(drive: Drive, scene: Scene, found: TriangulatedPoints) -> float:
    """The median distance in pixels of projections of points, by the poses of a scene, from the nearest feature."""
    seen = views(drive, RigImages.of(drive.scene, range(len(drive.scene.frames))), street_points(400), 0.0)
    errors = []
    for i, frame in enumerate(scene.frames):
        own = found.points[found.seen_point[found.seen_by == i]]
        k = continuous_intrinsics(frame, (frame.width, frame.height))
        pixels, _ = project(own, inverse(frame.camera_to_world), k)
        errors.append(cKDTree(seen[i].pixels).query(pixels)[0])
    return float(np.median(np.concatenate(errors)))


def test_points_that_are_kept_fit_the_given_poses_and_no_refined_ones(tmp_path):
    """Poses that are off: a refinement that is accepted moves the points with them, one that is not does not."""
    drive, found = drive_of(10), {}
    for name, limits in (("accepted", {}), ("kept", {"min_gain": 0.999})):
        (tmp_path / name).mkdir()
        found[name] = refined_of(tmp_path / name, drive, noise=0.0, rounds=1, limits=limits)
        assert found[name].record["refined"] == (name == "accepted")
    accepted, kept = found["accepted"], found["kept"]
    assert median_error(drive, accepted.scene, accepted.points) < 0.5 * median_error(
        drive, drive.scene, accepted.points
    )
    assert median_error(drive, drive.scene, kept.points) < 0.5 * median_error(drive, accepted.scene, kept.points)


def test_withheld_points_take_no_part_in_the_trial_adjustment(tmp_path, monkeypatch):
    """The trial adjusts poses without them, then fits all points to given and refined poses, which are fixed."""
    drive = drive_of(8)
    images, job = RigImages.of(drive.scene, range(8)), job_of(withheld=0.25)
    seen = views(drive, images, street_points(300))
    start = triangulate(write_database(tmp_path / "f.db", images, seen, job), tmp_path / "f.db", job, 1)
    calls = []

    def watched(reconstruction, priors, *rest):
        before = refine.poses_of(reconstruction)
        bundle_adjust(reconstruction, priors, *rest)
        moves = np.abs(refine.poses_of(reconstruction) - before).max()
        calls.append((set(reconstruction.points3D), priors is not None, moves > 1e-4))

    monkeypatch.setattr(refine, "bundle_adjust", watched)
    trial, _ = refine._trial(start, priors_of(images, job.refine_poses), job, 1)
    everything = set(start.points3D)
    (fitted, *judged) = calls
    assert len(everything - fitted[0]) == trial.points == round(0.25 * len(everything)) and fitted[1:] == (True, True)
    assert judged == [(everything, False, False)] * 2
    assert trial.after < 0.5 * trial.before


def test_a_camera_may_miss_key_frames_and_have_images_of_its_own_size(tmp_path):
    wide, small = drive_of(8), drive_of(8, ("CAM_FRONT_LEFT",), size=(400, 300))
    kept = [i for i in range(8) if i not in (0, 3, 4)]
    frames = (*wide.scene.frames, *(small.scene.frames[i] for i in kept))
    truth = np.concatenate([wide.truth, small.truth[kept]])
    drive = Drive(dataclasses.replace(wide.scene, frames=frames), truth)
    record = refined_of(tmp_path, drive, 600, rounds=2, limits={"min_points": 20}).record
    assert record["refined"] and record["images"] == 13
    assert record["trial"]["after_px"] < 0.5 * record["trial"]["before_px"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera_to_world": np.array([0.0, 0.0, 0.1])}, "CAM_FRONT moves on the car"),
        ({"intrinsics": np.array([5.0, 0.0, 0.0])}, "the intrinsics of CAM_FRONT change within the drive"),
    ],
)
def test_a_camera_that_is_not_fixed_is_named(tmp_path, change, words):
    drive = drive_of(3)
    (name, by), frame = *change.items(), drive.scene.frames[1]
    changed = getattr(frame, name).copy()
    changed[:3, -1] += by
    frames = (drive.scene.frames[0], dataclasses.replace(frame, **{name: changed}), drive.scene.frames[2])
    with pytest.raises(DatasetError, match=f"scene made: .*{words}"):
        refined_of(tmp_path, Drive(dataclasses.replace(drive.scene, frames=frames), drive.truth))


def painted(folder, drive: Drive, paint) -> Drive:
    """The drive with images on disk: `paint` gives the pixels of a frame."""
    frames = []
    for i, frame in enumerate(drive.scene.frames):
        path = folder / f"{i}.png"
        Image.fromarray(paint(i, frame)).save(path)
        frames.append(dataclasses.replace(frame, image_path=str(path)))
    return Drive(dataclasses.replace(drive.scene, frames=tuple(frames)), drive.truth)


SMALL = (160, 90)


def black(i, frame) -> np.ndarray:
    return np.zeros((frame.height, frame.width, 3), dtype=np.uint8)


def pattern(i, frame) -> np.ndarray:
    cells = np.random.default_rng(0).integers(0, 255, (15, 27, 1), dtype=np.uint8)
    return np.kron(cells, np.ones((6, 6, 3), dtype=np.uint8))[: frame.height, : frame.width]


@pytest.mark.parametrize(
    ("key_frames", "paint"),
    [
        (3, black),
        (1, pattern),
        (3, lambda i, frame: black(i, frame) if i == 1 else pattern(i, frame)),
    ],
    ids=["no image has features", "there is one image", "one of the images has none"],
)
def test_images_without_features_or_matches_leave_the_poses(tmp_path, key_frames, paint):
    drive = painted(tmp_path, drive_of(key_frames, size=SMALL), paint)
    refined = refine_poses(drive.scene, job_of())
    assert refined.record["refined"] is False and refined.scene is drive.scene
    assert canonical_json(refined.record) and refined.record["trial"] is None


def without_pycolmap(folder, monkeypatch) -> tuple[Drive, str]:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.delitem(sys.modules, "drivesplat.preprocess.poses.refine", raising=False)
    return painted(folder, drive_of(3, size=SMALL), pattern), "pycolmap or pyceres cannot be imported"


def camera_that_moves(folder, monkeypatch) -> tuple[Drive, str]:
    drive = painted(folder, drive_of(3, size=SMALL), pattern)
    first, *others = drive.scene.frames
    first = dataclasses.replace(first, camera_to_world=first.camera_to_world @ shift(0.1))
    return dataclasses.replace(drive, scene=dataclasses.replace(drive.scene, frames=(first, *others))), "moves on the"


@pytest.mark.parametrize("obstacle", [without_pycolmap, camera_that_moves])
class TestImpossibleRefinement:
    def test_keeps_the_poses_where_refinement_is_optional(self, obstacle, tmp_path, monkeypatch, caplog):
        drive, words = obstacle(tmp_path, monkeypatch)
        with caplog.at_level(logging.WARNING):
            kept = refine_or_keep(drive.scene, job_of(enabled="auto"))
        assert kept.scene is drive.scene and words in kept.record["kept_because"] and not kept.record["refined"]
        assert [words in record.message for record in caplog.records] == [True]
        assert len(kept.points.points) == len(kept.points.seen_by) == 0
        tried = painted(tmp_path, drive_of(1, size=SMALL), black)
        monkeypatch.undo()
        assert kept.record.keys() == refine_poses(tried.scene, job_of()).record.keys()

    @pytest.mark.parametrize("settings", [{"enabled": True}, {"enabled": "auto", "start": "images"}])
    def test_fails_where_refinement_is_required(self, obstacle, tmp_path, monkeypatch, settings):
        drive, words = obstacle(tmp_path, monkeypatch)
        with pytest.raises(DriveSplatError, match=words) as failure:
            refine_or_keep(drive.scene, job_of(**settings))
        assert "\n" not in str(failure.value) and "made" in str(failure.value)


def test_a_possible_refinement_is_done(tmp_path):
    drive = painted(tmp_path, drive_of(3, size=SMALL), pattern)
    assert refine_or_keep(drive.scene, job_of()).record == refine_poses(drive.scene, job_of()).record
