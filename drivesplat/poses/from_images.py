"""A scene's poses made from its images alone, brought to metres and to where the recorded ones are, if there are any.

A model made from images can be moved, turned and scaled as a whole, and its scale creeps along the drive. LiDAR's
depths give the scale of every stretch; rotation and translation are those that fit the recorded poses best, or put the
first image where it was recorded.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from drivesplat.errors import DatasetError
from drivesplat.poses.corrections import Corrections, corrected
from drivesplat.poses.mapping import REMEDY, Model, mapped
from drivesplat.poses.rig import RigImages
from drivesplat.poses.scale import STRETCHES, by_lidar, by_positions, drift, moves, strays, told_by_lidar
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import LimitSettings, PriorSettings, RefinePosesJob

ROUNDS = 2
"""Sweeps are placed by the recorded poses first, and then by those that this has given."""


@dataclass(frozen=True)
class Placement:
    """`corrections` lead from recorded poses to those of the images that were placed. `follows`: whether recorded poses
    move, so that these lie where those do. `record`: what poses.json says of it."""

    corrections: Corrections
    follows: bool
    record: dict[str, Any]


def placed_by_images(images: RigImages, database: Path, job: RefinePosesJob, threads: int) -> Placement:
    """Where images whose features and matches are in `database` were taken, by these alone.

    Raises DatasetError where the drive does not allow to tell: too few images hang together, nothing gives a scale, or
    the scale drifts.
    """
    model, limits = mapped(images, database, job, threads), job.refine_poses.limits
    given, scene = np.stack([frame.ego_to_world for frame in images.frames]), images.scene
    follows = moves(given[model.placed])
    for _ in range(ROUNDS):
        told_by, scales = _scales(scene, images, model, job)
        misplaced = strays(scales, limits.max_scale_drift)
        _require_steady(scene, told_by, scales, misplaced, limits)
        model, scales = model.without(misplaced), scales[~misplaced]
        recorded = given[model.placed]
        poses = aligned(recorded, _cars(images, model, scales), job.refine_poses.priors)
        corrections = Corrections.between(images.timestamps[model.placed], recorded, poses)
        if not follows:
            corrections = corrections.continued(scene.key_frame_interval)
        scene = corrected(images.scene, corrections)
    record = {
        "camera": model.camera,
        "images_placed": len(model.placed),
        "models": list(model.sizes),
        "scale_from": told_by,
        "scale": float(np.nanmedian(scales)),
        "scale_drift": drift(scales),
        "aligned_to": "recorded poses" if follows else "first image",
    }
    return Placement(corrections, follows, record)


def _require_steady(
    scene: Scene, told_by: str, scales: np.ndarray, misplaced: np.ndarray, limits: LimitSettings
) -> None:
    where = f"scene {scene.name}: images alone give no poses: by {told_by}"
    why = f"more than refine_poses.limits allows, as where a car drives straight ahead; {REMEDY}"
    if misplaced.mean() > 1.0 - limits.min_images:
        raise DatasetError(f"{where} {misplaced.sum()} of {len(misplaced)} images are misplaced (min_images), {why}")
    factor = drift(scales[~misplaced])
    if not factor <= limits.max_scale_drift:
        raise DatasetError(
            f"{where} their scale changes by a factor of {factor:.2f} along the drive (max_scale_drift), {why}"
        )


def _scales(scene: Scene, images: RigImages, model: Model, job: RefinePosesJob) -> tuple[str, np.ndarray]:
    """What tells the scale, and metres a unit (n,) of the model's images; images and sweeps are where `scene` has them.
    Raises DatasetError where nothing does."""
    if job.lidar is not None:
        scales = by_lidar(scene, images, model, job.lidar)
        if told_by_lidar(scales):
            return "LiDAR", scales
    scales = by_positions(np.stack([images.frames[i].camera_to_world for i in model.placed]), model)
    if np.isfinite(scales).any():
        return "recorded positions", scales
    raise DatasetError(
        f"scene {scene.name}: images alone give no poses in metres: LiDAR meets too few of the points that images see, "
        f"and recorded positions do not move; {REMEDY}, or LiDAR sweeps within 0.1 s of the images"
    )


def _cars(images: RigImages, model: Model, scales: np.ndarray) -> np.ndarray:
    """The car's poses (n, 4, 4), in metres, by its cameras' and their mounts."""
    frames = [images.frames[i] for i in model.placed]
    mounts = np.stack([inverse(frame.camera_to_world) @ frame.ego_to_world for frame in frames])
    return in_metres(model.camera_to_model, scales) @ mounts


def in_metres(poses: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) of a model, in the order of time, with every step from one to the next scaled as its stretch of
    the drive is: by the running median of `scales` (n,), metres a unit, of which some may be NaN."""
    known = np.flatnonzero(np.isfinite(scales))
    smooth = median_filter(scales[known], size=max(1, len(known) // STRETCHES) | 1, mode="nearest")
    local = np.interp(np.arange(len(scales)), known, smooth)
    steps = np.diff(poses[:, :3, 3], axis=0) * (0.5 * (local[1:] + local[:-1]))[:, None]
    result = poses.copy()
    result[:, :3, 3] = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return result


def aligned(recorded: np.ndarray, poses: np.ndarray, priors: PriorSettings) -> np.ndarray:
    """Poses (n, 4, 4), moved and turned together to where the `recorded` ones (n, 4, 4) are; where these stand still,
    the first one to its recorded place.

    Least squares of positions and rotations, each in units of its prior's deviation (Umeyama 1991, a rotation's columns
    as further points): positions alone leave the roll open on a straight road, rotations alone turn the far end aside.
    """
    if not moves(recorded):
        return recorded[0] @ inverse(poses[0]) @ poses
    places = [some[:, :3, 3] for some in (recorded, poses)]
    means = [some.mean(axis=0) for some in places]
    by_place = (places[0] - means[0]).T @ (places[1] - means[1]) / priors.position**2
    by_turn = np.einsum("nij,nkj->ik", recorded[:, :3, :3], poses[:, :3, :3]) / (2.0 * priors.tilt**2)
    u, _, vt = np.linalg.svd(by_place + by_turn)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rigid(turn, means[0] - turn @ means[1]) @ poses
