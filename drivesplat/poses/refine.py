"""The stage `refine_poses`: a scene's poses corrected by what its images show, or kept where that cannot be trusted;
or made from the images alone (`drivesplat.poses.from_images`), or nothing where these do not tell.

Key frames of all cameras take part, held-out ones among them (`protocol.poses` says so); images between key frames,
sweeps and boxes follow. A trial without some of the points decides: refined poses must fit them clearly better.
"""

import logging
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from drivesplat.poses.adjustment import (
    Priors,
    adjust,
    observations,
    priors_of,
    triangulated,
    with_poses_of,
    without_points,
)
from drivesplat.poses.corrections import Corrections, corrected
from drivesplat.poses.features import find_features, match_features
from drivesplat.poses.from_images import placed_by_images
from drivesplat.poses.observations import Observations
from drivesplat.poses.refinement_record import Refinement, verdict
from drivesplat.poses.rig import RigImages, from_pycolmap
from drivesplat.poses.triangulated import no_points, triangulated_points
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import LimitSettings, RefinePosesJob

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Trial:
    """What points that took no part in an adjustment say of its poses: median reprojection errors in pixels, `before`
    with the given poses and `after` with the refined ones, over so many `observations`."""

    points: int
    observations: int
    before: float
    after: float


def refine_poses(scene: Scene, job: RefinePosesJob, ego_mask: EgoMask = NO_EGO_MASK, threads: int = 1) -> Refinement:
    """The refinement of a scene; features on the own car do not count. Logs a warning, and keeps the given poses,
    where images cannot improve them.

    Raises DatasetError where an image cannot be read, or a camera is not fixed to the car; and where poses are to come
    from images alone, and these do not tell them.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR
    key_frames = [i for i, frame in enumerate(scene.frames) if frame.is_key_frame]
    images = RigImages.of(scene, key_frames, ego_mask)
    with tempfile.TemporaryDirectory(prefix="drivesplat-poses-") as folder:
        database = Path(folder) / "features.db"
        start = find_features(images, job, database, threads)
        match_features(images, job, database, threads)
        if job.refine_poses.start == "images":
            return made_by_matches(images, start, database, job, threads)
        return refined_by_matches(images, start, database, job, threads)


def refined_by_matches(
    images: RigImages, start: pycolmap.Reconstruction, database: Path, job: RefinePosesJob, threads: int = 1
) -> Refinement:
    """The refinement of a scene whose images and features are in `start`, and their matches in `database`."""
    scene, priors = images.scene, priors_of(images, job.refine_poses)
    untouched, reconstruction = _adjusted(start, priors, database, job, threads)
    seen = observations(reconstruction)
    corrections = _corrections(images, seen, priors.given, poses_of(reconstruction))
    trial = _trial(untouched, priors, job, threads) if len(seen.positions) else None
    changes = corrections.at(images.timestamps)
    fault = doubt(images, seen, changes, trial, job.refine_poses.limits)
    record = {**verdict(scene, job, fault), **_record(images, seen, changes, trial)}
    if fault is not None:
        log.warning("scene %s: poses stay as they are: %s", scene.name, fault)
        return Refinement(scene, record, no_points())
    return Refinement(corrected(scene, corrections), record, triangulated_points(images.indices, seen))


def made_by_matches(
    images: RigImages, start: pycolmap.Reconstruction, database: Path, job: RefinePosesJob, threads: int = 1
) -> Refinement:
    """The same with poses from images alone: those that the mapper placed, the others after their neighbours, and all
    adjusted as recorded ones are. Raises DatasetError where the drive does not allow it."""
    placement = placed_by_images(images, database, job, threads)
    scene = corrected(images.scene, placement.corrections)
    priors = priors_of(RigImages.of(scene, images.indices, images.ego_mask), job.refine_poses)
    _, reconstruction = _adjusted(with_poses_of(start, priors.given), priors, database, job, threads)
    seen = observations(reconstruction)
    recorded = np.stack([frame.ego_to_world for frame in images.frames])
    corrections = _corrections(images, seen, recorded, poses_of(reconstruction))
    described = _record(images, seen, corrections.at(images.timestamps), None)
    if not placement.follows:
        described |= {"shift_m": None, "turn_deg": None}
        corrections = corrections.continued(images.scene.key_frame_interval)
    record = {**verdict(scene, job, None), "placement": placement.record, **described}
    made = corrected(images.scene, corrections, poses="images")
    return Refinement(made, record, triangulated_points(images.indices, seen))


def _adjusted(
    start: pycolmap.Reconstruction, priors: Priors, database: Path, job: RefinePosesJob, threads: int
) -> tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]:
    """Points triangulated with the poses so far, and both adjusted, in rounds: before and after the last adjustment."""
    reconstruction = start
    for _ in range(job.refine_poses.rounds):
        reconstruction = triangulated(reconstruction, database, job, threads)
        untouched = pycolmap.Reconstruction(reconstruction)
        adjust(reconstruction, priors, job.refine_poses.robust_pixels, threads)
    return untouched, reconstruction


def _corrections(images: RigImages, seen: Observations, given: np.ndarray, refined: np.ndarray) -> Corrections:
    """From given to refined ego_to_world (n, 4, 4), at the times of the images that see points: the others follow. None
    at all where no image does."""
    held = np.unique(seen.image)
    if not len(held):
        return Corrections.between(images.timestamps[:1], given[:1], given[:1])
    return Corrections.between(images.timestamps[held], given[held], refined[held])


def poses_of(reconstruction: pycolmap.Reconstruction) -> np.ndarray:
    """ego_to_world (n, 4, 4) of all images, in the order of their numbers."""
    moments = (reconstruction.frames[number] for number in sorted(reconstruction.frames))
    return np.stack([inverse(from_pycolmap(moment.rig_from_world)) for moment in moments])


def _trial(start: pycolmap.Reconstruction, priors: Priors, job: RefinePosesJob, threads: int) -> Trial:
    """Adjusts `start` without some of its points, and lets these say what that is worth."""
    settings, numbers = job.refine_poses, sorted(start.points3D)
    random = np.random.default_rng(job.random_seed)
    withheld = random.choice(numbers, max(1, round(settings.withheld * len(numbers))), replace=False)
    without = without_points(start, withheld.tolist())
    adjust(without, priors, settings.robust_pixels, threads)
    medians = []
    for poses in (priors.given, poses_of(without)):
        judged = with_poses_of(start, poses)
        adjust(judged, None, settings.robust_pixels, threads)
        seen = observations(judged)
        errors = seen.error[seen.of_points(withheld)]
        medians.append(float(np.median(errors)) if len(errors) else np.inf)
    return Trial(len(withheld), len(errors), *medians)


def doubt(
    images: RigImages, seen: Observations, changes: np.ndarray, trial: Trial | None, limits: LimitSettings
) -> str | None:
    """Why a refinement is not believed, None where it is. `changes` (n, 4, 4) are the corrections of its images."""
    points = np.bincount(seen.image, minlength=len(images))
    held = points >= limits.min_points
    if trial is None or held.mean() < limits.min_images:
        return (
            f"{int(held.sum())} of {len(images)} images see {limits.min_points} points or more that could be "
            "triangulated (by night, or where the car stands, there are few)"
        )
    shift, turn = _sizes(changes)
    for largest, limit, unit in ((shift.max(), limits.max_shift, "m"), (turn.max(), limits.max_turn, "degrees")):
        if not largest <= limit:
            return f"one of them would be moved by {largest:.2f} {unit}, more than {limit:g}"
    if not trial.after < (1.0 - limits.min_gain) * trial.before:
        return (
            f"points that took no part are off by {trial.after:.2f} pixels with the refined ones and by "
            f"{trial.before:.2f} with these, a gain of less than {limits.min_gain:.0%}"
        )
    return None


def _sizes(changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far (n,) in metres and how much (n,) in degrees transforms (n, 4, 4) move."""
    turns = Rotation.from_matrix(changes[:, :3, :3]).magnitude()
    return np.linalg.norm(changes[:, :3, 3], axis=1), np.degrees(turns)


def _record(images: RigImages, seen: Observations, changes: np.ndarray, trial: Trial | None) -> dict[str, Any]:
    """What poses.json says beside the verdict: how well points fit, how far poses moved, image by image."""
    shift, turn = _sizes(changes)
    points = np.bincount(seen.image, minlength=len(images))
    turns = Rotation.from_matrix(changes[:, :3, :3]).as_rotvec(degrees=True)
    return {
        "images": len(images),
        "points": len(seen.positions),
        "observations": len(seen.point),
        "points_per_image": {"least": int(points.min()), "median": float(np.median(points))},
        "reprojection_px": _finite_median(seen.error),
        "trial": None if trial is None else _trial_record(trial),
        "shift_m": {"median": float(np.median(shift)), "largest": float(shift.max())},
        "turn_deg": {"median": float(np.median(turn)), "largest": float(turn.max())},
        "corrections": [
            {
                "camera": frame.camera,
                "timestamp": frame.timestamp,
                "points": int(count),
                "translation_m": change[:3, 3].round(6).tolist(),
                "rotation_deg": rotation.round(6).tolist(),
            }
            for frame, count, change, rotation in zip(images.frames, points, changes, turns, strict=True)
        ],
    }


def _finite_median(errors: np.ndarray) -> float | None:
    median = float(np.median(errors)) if len(errors) else np.inf
    return median if np.isfinite(median) else None


def _trial_record(trial: Trial) -> dict[str, Any]:
    return {
        "points": trial.points,
        "observations": trial.observations,
        "before_px": trial.before if np.isfinite(trial.before) else None,
        "after_px": trial.after if np.isfinite(trial.after) else None,
    }
