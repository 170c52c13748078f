"""Poses of a scene refined with its images, kept where the refinement is not trusted, or estimated from images alone.

Key frames of all cameras take part, including held-out ones (`protocol.poses` says so); images between key frames,
sweeps and boxes take interpolated corrections. A trial without some of the points decides: refined poses must fit these
points clearly better.
"""

import logging
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.adjustment import (
    Priors,
    adjust_in_rounds,
    bundle_adjust,
    observations_of,
    poses_of,
    priors_of,
    with_poses,
)
from drivesplat.preprocess.poses.corrections import Corrections, apply_corrections, magnitudes
from drivesplat.preprocess.poses.features import detect_features, match_features
from drivesplat.preprocess.poses.from_images import estimate_poses
from drivesplat.preprocess.poses.from_matches import MatchJudge, match_judge
from drivesplat.preprocess.poses.from_sweeps import SweepJudge
from drivesplat.preprocess.poses.lens import lens_warnings, with_tested_images
from drivesplat.preprocess.poses.readout import RollingFeatures
from drivesplat.preprocess.poses.refinement_record import Refinement, finite, record_header
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.preprocess.poses.triangulated import Observations, no_points, triangulated_points
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import LimitSettings, RefinePosesJob

log = logging.getLogger(__name__)

CHORD = 2.0
"""Metres between places whose distances make the length of a path."""
MIN_PATH = 5.0
"""Metres of a recorded path below which noise hides a change of its length."""


@dataclass(frozen=True)
class WithheldTrial:
    """Median reprojection errors (pixels) of points withheld from an adjustment: `before` with given poses, `after`
    with refined ones."""

    points: int
    observations: int
    before: float
    after: float


def refine_poses(
    scene: Scene,
    job: RefinePosesJob,
    ego_mask: EgoMask = NO_EGO_MASK,
    threads: int = 1,
    judge: SweepJudge | None = None,
) -> Refinement:
    """Refines a scene's poses with its images; features on the ego vehicle are ignored. Where these cannot improve the
    given poses, or withheld measurements object (LiDAR's `judge`, matches over longer baselines), logs a warning and
    keeps the given ones. Where LiDAR alone objects, only cameras move.

    Raises DatasetError where an image cannot be read or the mount of a camera changes; with `start: images` also where
    images do not determine the poses.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR
    key_frames = [i for i, frame in enumerate(scene.frames) if frame.is_key_frame]
    images = RigImages.of(scene, key_frames, ego_mask)
    with tempfile.TemporaryDirectory(prefix="drivesplat-poses-") as folder:
        database = Path(folder) / "features.db"
        log.info("scene %s: features of %d images are searched", scene.name, len(images))
        start = detect_features(images, job, database, threads)
        log.info("scene %s: features are detected", scene.name)
        match_features(images, job, database, threads)
        log.info("scene %s: features are matched", scene.name)
        if job.refine_poses.start == "images":
            return estimate_from_matches(images, start, database, job, threads)
        matches = match_judge(images, job, database, threads)
        refinement = refine_from_matches(images, start, database, job, threads, judge, matches)
    sentences = lens_warnings(with_tested_images(scene), ego_mask, threads)
    for sentence in sentences:
        log.warning("scene %s: %s", scene.name, sentence)
    return replace(refinement, record={**refinement.record, "lens_warnings": sentences})


def refine_from_matches(
    images: RigImages,
    start: pycolmap.Reconstruction,
    database: Path,
    job: RefinePosesJob,
    threads: int = 1,
    sweeps: SweepJudge | None = None,
    matches: MatchJudge | None = None,
) -> Refinement:
    """Refines given poses, with images and features in `start` and matches in `database`. Where refined poses are not
    better than the given ones, these and points that fit them are kept; where they cannot be trusted, no points.
    Withheld `sweeps` and `matches` have the last word; with sweeps, the given poses are as accurate as LiDAR."""
    scene, settings = images.scene, job.refine_poses
    priors = priors_of(images, settings, settings.priors_with_lidar if sweeps else None)
    rolling = RollingFeatures.of(images, start)
    unadjusted, reconstruction = adjust_in_rounds(start, rolling, priors, database, job, threads)
    observations = observations_of(reconstruction)
    corrections = _corrections(images, observations, poses_of(reconstruction))
    trial, at_given = _trial(unadjusted, priors, job, threads) if len(observations.positions) else (None, None)
    changes, limits = corrections.at(images.timestamps), job.refine_poses.limits
    flaw = unusable(images, observations, changes, trial, limits)
    refined = scene if flaw else apply_corrections(scene, corrections)
    judges = [judge for judge in (sweeps, matches) if judge and not flaw]
    judged = {judge.name: (judge.distance(scene), judge.distance(refined)) for judge in judges}
    objections = {judge.name: judge.objection(*judged[judge.name]) for judge in judges}
    by_lidar = objections.pop(SweepJudge.name, None)
    reason = flaw or no_gain(trial, limits) or next(filter(None, objections.values()), None)
    if reason is None and (sweeps is None or by_lidar):
        reason = stretched(scene, refined, limits)
    if reason is None and by_lidar and not objections:  # nothing else that was withheld speaks for the images
        reason = by_lidar
    record = {**record_header(scene, job, reason), **_record(images, observations, changes, trial)}
    if judged:
        record["judged"] = {
            name: {"before": finite(before), "after": finite(after)} for name, (before, after) in judged.items()
        }
    log.info("scene %s: %s", scene.name, _figures(record))
    if reason is None:
        if by_lidar:
            log.info(
                "scene %s: the refined poses are taken for cameras, LiDAR and boxes stay: %s", scene.name, by_lidar
            )
            refined = replace(scene, frames=refined.frames, poses=refined.poses)
            record["cameras_alone_because"] = by_lidar
        else:
            log.info("scene %s: the refined poses are taken", scene.name)
        return Refinement(refined, record, triangulated_points(images.indices, observations))
    log.warning("scene %s: poses stay as they are: %s", scene.name, reason)
    points = no_points() if flaw or at_given is None else triangulated_points(images.indices, at_given)
    return Refinement(scene, record, points)


def estimate_from_matches(
    images: RigImages, start: pycolmap.Reconstruction, database: Path, job: RefinePosesJob, threads: int = 1
) -> Refinement:
    """Estimates poses from images alone and then refines them. Images that the mapper did not place are interpolated.
    Raises DatasetError where the drive does not determine the poses."""
    estimate = estimate_poses(images, database, job, threads)
    scene = apply_corrections(images.scene, estimate.corrections)
    placed = RigImages.of(scene, images.indices, images.ego_mask)
    priors, rolling = priors_of(placed, job.refine_poses), RollingFeatures.of(placed, start)
    _, reconstruction = adjust_in_rounds(with_poses(start, priors.given), rolling, priors, database, job, threads)
    observations = observations_of(reconstruction)
    corrections = _corrections(images, observations, poses_of(reconstruction))
    measured = _record(images, observations, corrections.at(images.timestamps), None)
    if not estimate.recorded_move:
        measured |= {"shift_m": None, "turn_deg": None}
        corrections = corrections.extrapolated(images.scene.key_frame_interval)
    record = {**record_header(scene, job, None), "placement": estimate.record, **measured}
    log.info("scene %s: poses from images alone: %s", scene.name, _figures(record))
    scene = apply_corrections(images.scene, corrections, poses="images")
    return Refinement(scene, record, triangulated_points(images.indices, observations))


def _corrections(images: RigImages, observations: Observations, refined: np.ndarray) -> Corrections:
    """From recorded to refined ego_to_world (n, 4, 4) at the times of images that see points; identity without any."""
    given, constrained = images.ego_to_world, np.unique(observations.image)
    if not len(constrained):
        return Corrections.from_poses(images.timestamps[:1], given[:1], given[:1])
    return Corrections.from_poses(images.timestamps[constrained], given[constrained], refined[constrained])


def _trial(
    start: pycolmap.Reconstruction, priors: Priors, job: RefinePosesJob, threads: int
) -> tuple[WithheldTrial, Observations]:
    """Adjusts `start` without some of its points, then fits all to the given and to the refined poses. Also returns the
    points fitted to the given poses."""
    settings, numbers = job.refine_poses, sorted(start.points3D)
    random = np.random.default_rng(job.random_seed)
    withheld = random.choice(numbers, max(1, round(settings.withheld * len(numbers))), replace=False)
    reduced = pycolmap.Reconstruction(start)
    for point in withheld.tolist():
        reduced.delete_point3D(point)
    bundle_adjust(reduced, priors, settings.robust_pixels, threads)
    fitted = []
    for poses in (priors.given, poses_of(reduced)):
        whole = with_poses(start, poses)
        bundle_adjust(whole, None, settings.robust_pixels, threads)
        fitted.append(observations_of(whole))
    errors = [points.error[np.isin(points.numbers[points.point], withheld)] for points in fitted]
    return WithheldTrial(len(withheld), len(errors[-1]), *map(_median, errors)), fitted[0]


def unusable(
    images: RigImages,
    observations: Observations,
    changes: np.ndarray,
    trial: WithheldTrial | None,
    limits: LimitSettings,
) -> str | None:
    """Why a refinement cannot be trusted, None where it can. `changes` (n, 4, 4): corrections of the images."""
    constrained = np.bincount(observations.image, minlength=len(images)) >= limits.min_points
    if trial is None or constrained.mean() < limits.min_images:
        return (
            f"{int(constrained.sum())} of {len(images)} images see {limits.min_points} triangulated points or more "
            "(there are few by night, where the vehicle stands, or with wrong poses or calibration)"
        )
    sizes = magnitudes(changes)
    for key, limit, unit in (("shift_m", limits.max_shift, "m"), ("turn_deg", limits.max_turn, "degrees")):
        largest = sizes[key]["largest"]
        if not largest <= limit:
            return (
                f"one of them would be moved by {largest:.2f} {unit}, more than {limit:g} (as with a camera matrix K "
                "of another image size, a lens distortion that is not stated, or wrong poses or mounts)"
            )
    return None


def no_gain(trial: WithheldTrial | None, limits: LimitSettings) -> str | None:
    """Why refined poses are not better than the given ones, None where they are, or where nothing was tried."""
    if trial is not None and not trial.after < (1.0 - limits.min_gain) * trial.before:
        return (
            f"the error of withheld points is {trial.after:.2f} pixels with refined poses and {trial.before:.2f} with "
            f"the given ones, a gain of less than {limits.min_gain:.0%}"
        )
    return None


def stretched(given: Scene, refined: Scene, limits: LimitSettings) -> str | None:
    """Why the length of the path speaks against refined poses; None if it does not."""
    before, after = path_length(given), path_length(refined)
    if before < MIN_PATH or abs(after - before) <= limits.max_stretch * before:
        return None
    return f"with them the path is {after:.1f} m long, {before:.1f} m as recorded"


def path_length(scene: Scene) -> float:
    """The length in metres of the vehicle's path at its images, of chords of CHORD metres and more: noise of positions
    does not count."""
    frames = sorted(scene.frames, key=lambda frame: frame.timestamp)
    length, start = 0.0, frames[0].ego_to_world[:3, 3]
    for frame in frames[1:]:
        chord = float(np.linalg.norm(frame.ego_to_world[:3, 3] - start))
        if chord >= CHORD or frame is frames[-1]:
            length, start = length + chord, frame.ego_to_world[:3, 3]
    return length


def _record(
    images: RigImages, observations: Observations, changes: np.ndarray, trial: WithheldTrial | None
) -> dict[str, Any]:
    """The measured part of poses.json: errors of points, corrections of poses, both also per image."""
    points = np.bincount(observations.image, minlength=len(images))
    rotations = Rotation.from_matrix(changes[:, :3, :3]).as_rotvec(degrees=True)
    return {
        "images": len(images),
        "points": len(observations.positions),
        "observations": len(observations.point),
        "points_per_image": {"least": int(points.min()), "median": float(np.median(points))},
        "reprojection_px": finite(_median(observations.error)),
        "trial": trial
        and {
            "points": trial.points,
            "observations": trial.observations,
            "before_px": finite(trial.before),
            "after_px": finite(trial.after),
        },
        "judged": None,
        "cameras_alone_because": None,
        **magnitudes(changes),
        "corrections": [
            {
                "camera": frame.camera,
                "timestamp": frame.timestamp,
                "points": int(count),
                "translation_m": change[:3, 3].round(6).tolist(),
                "rotation_deg": rotation.round(6).tolist(),
            }
            for frame, count, change, rotation in zip(images.frames, points, changes, rotations, strict=True)
        ],
    }


def _figures(record: dict[str, Any]) -> str:
    """The figures of poses.json in a line."""
    trial, parts = record["trial"], [f"{record['images']} images, {record['points']} points"]
    for name, value in {
        "reprojection error": record["reprojection_px"],
        "of withheld points with given poses": trial and trial["before_px"],
        "and with refined ones": trial and trial["after_px"],
    }.items():
        parts += [f"{name} {value:.2f} pixels"] if value is not None else []
    for name, key, unit in (("shift", "shift_m", "m"), ("turn", "turn_deg", "degrees")):
        if record[key]:
            parts.append(f"median {name} {record[key]['median']:.3f} {unit}, largest {record[key]['largest']:.3f}")
    return ", ".join(parts)


def _median(errors: np.ndarray) -> float:
    """The median, infinite without any errors."""
    return float(np.median(errors)) if len(errors) else np.inf
