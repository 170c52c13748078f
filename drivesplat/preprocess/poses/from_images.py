"""Metric ego poses from images alone, in the frame of the recorded poses.

A model made from images is defined up to rotation, translation and scale, and its scale drifts. LiDAR depths give the
scale of each segment of the drive. Rotation and translation are those that fit the recorded poses best; where these do
not move, the first image keeps its recorded pose.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from drivesplat.errors import DatasetError
from drivesplat.preprocess.poses import scale
from drivesplat.preprocess.poses.corrections import Corrections, apply_corrections
from drivesplat.preprocess.poses.mapping import REMEDY, MappedImages, map_images
from drivesplat.preprocess.poses.rig import RigImages, ego_to_camera
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import PriorSettings, RefinePosesJob

ROUNDS = 2
"""The first round places sweeps by recorded poses, the second by the estimated ones."""


@dataclass(frozen=True)
class EstimatedPoses:
    """`corrections` from recorded to estimated poses; `recorded_move`: whether recorded poses move, so that estimated
    ones are aligned to them; `record`: the key `placement` of poses.json."""

    corrections: Corrections
    recorded_move: bool
    record: dict[str, Any]


def estimate_poses(images: RigImages, database: Path, job: RefinePosesJob, threads: int) -> EstimatedPoses:
    """Ego poses of images from their features and matches in `database`.

    Raises DatasetError where the drive does not determine them: too few connected images, no scale, or a scale that
    drifts.
    """
    model, limits = map_images(images, database, job, threads), job.refine_poses.limits
    given, scene = images.ego_to_world, images.scene
    recorded_move = scale.is_moving(given[model.placed])
    for _ in range(ROUNDS):
        source, scales = _scales(scene, images, model, job)
        outliers = scale.scale_outliers(scales, limits.max_scale_drift)
        model, scales = model.without(outliers), scales[~outliers]
        drift = scale.scale_drift(scales)
        problem = None
        if outliers.mean() > 1.0 - limits.min_images:
            problem = f"{outliers.sum()} of {len(outliers)} images are misplaced (min_images)"
        elif not drift <= limits.max_scale_drift:
            problem = f"the scale changes by a factor of {drift:.2f} along the drive (max_scale_drift)"
        if problem:
            raise DatasetError(
                f"scene {scene.name}: no poses from images alone: according to {source}, {problem}, more than "
                f"refine_poses.limits allows, as where a vehicle drives straight ahead; {REMEDY}"
            )
        mounts = np.stack([ego_to_camera(images.frames[i]) for i in model.placed])
        recorded, poses = given[model.placed], metric_poses(model.camera_to_model, scales) @ mounts
        poses = align_poses(recorded, poses, job.refine_poses.priors)
        corrections = Corrections.from_poses(images.timestamps[model.placed], recorded, poses)
        if not recorded_move:
            corrections = corrections.extrapolated(scene.key_frame_interval)
        scene = apply_corrections(images.scene, corrections)
    record = {
        "camera": model.camera,
        "images_placed": len(model.placed),
        "models": list(model.sizes),
        "scale_from": source,
        "scale": float(np.nanmedian(scales)),
        "scale_drift": drift,
        "aligned_to": "recorded poses" if recorded_move else "first image",
    }
    return EstimatedPoses(corrections, recorded_move, record)


def _scales(scene: Scene, images: RigImages, model: MappedImages, job: RefinePosesJob) -> tuple[str, np.ndarray]:
    """The source of the scale, and metres per unit (n,) of the model's images, with sweeps as placed in `scene`. Raises
    DatasetError without a source."""
    if job.lidar is not None:
        scales = scale.scales_from_lidar(scene, images, model, job.lidar)
        if scale.enough_from_lidar(scales):
            return "LiDAR", scales
    recorded = np.stack([images.frames[i].camera_to_world for i in model.placed])
    scales = scale.scales_from_positions(recorded, model)
    if np.isfinite(scales).any():
        return "recorded positions", scales
    raise DatasetError(
        f"scene {scene.name}: no poses from images alone, because their scale is unknown: too few points of the images "
        f"have LiDAR depth, and recorded positions do not move; {REMEDY}, or LiDAR sweeps within 0.1 s of the images"
    )


def metric_poses(poses: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) of a model, in the order of time, in metres: each step is multiplied by the running median of
    `scales` (n,), metres per unit, which may contain NaN."""
    known = np.flatnonzero(np.isfinite(scales))
    smooth = median_filter(scales[known], size=max(1, len(known) // scale.SEGMENTS) | 1, mode="nearest")
    local = np.interp(np.arange(len(scales)), known, smooth)
    steps = np.diff(poses[:, :3, 3], axis=0) * (0.5 * (local[1:] + local[:-1]))[:, None]
    result = poses.copy()
    result[:, :3, 3] = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return result


def align_poses(recorded: np.ndarray, poses: np.ndarray, priors: PriorSettings) -> np.ndarray:
    """Poses (n, 4, 4) under the rigid transform that fits the `recorded` ones (n, 4, 4) best. Where these do not move,
    the first pose is mapped to the first recorded one.

    Least squares of positions and rotations in units of their priors (Umeyama 1991, with the columns of rotations as
    further points). Positions alone leave the roll on a straight road undetermined; rotations alone misplace the end.
    """
    if not scale.is_moving(recorded):
        return recorded[0] @ inverse(poses[0]) @ poses
    positions = [some[:, :3, 3] for some in (recorded, poses)]
    means = [some.mean(axis=0) for some in positions]
    by_position = (positions[0] - means[0]).T @ (positions[1] - means[1]) / priors.position**2
    by_rotation = np.einsum("nij,nkj->ik", recorded[:, :3, :3], poses[:, :3, :3]) / (2.0 * priors.tilt**2)
    u, _, vt = np.linalg.svd(by_position + by_rotation)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rigid(rotation, means[0] - rotation @ means[1]) @ poses
