"""Metric ego poses from images alone, in the frame of the recorded poses.

A model made from images is defined up to rotation, translation and scale, and its scale drifts. LiDAR gives the depth
of the surfaces on which images see points, and so the scale of each segment of the drive; without LiDAR, recorded
positions give it. A sweep is placed by the ego pose at its own time, up to 0.1 s from the image's. Rotation and
translation are those that fit the recorded poses best; where these do not move, the first image keeps its recorded
pose.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import median_filter
from scipy.spatial import QhullError, cKDTree

from drivesplat.errors import DatasetError
from drivesplat.lidar.coloring import visible
from drivesplat.lidar.occlusion import patches, unoccluded
from drivesplat.lidar.sweeps import nearest_returns
from drivesplat.preprocess.poses.corrections import Corrections, apply_corrections
from drivesplat.preprocess.poses.mapping import REMEDY, MappedImages, map_images
from drivesplat.preprocess.poses.rig import RigImages, ego_to_camera
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import LidarRays, PriorSettings, RefinePosesJob

ROUNDS = 2
"""The first round places sweeps by recorded poses, the second by the estimated ones."""
MAX_INTERVAL_US = 100_000.0
"""Maximum interval (microseconds) between an image and the sweep that gives its depths."""
MIN_DEPTHS = 10
"""Minimum number of points with LiDAR depth for an image to have a scale."""
MIN_LIDAR_FRACTION = 0.25
"""Minimum fraction of images with a scale from LiDAR."""
MIN_WINDOW = 2.0
"""Minimum half size (pixels) of the window that a return stands for."""
MIN_MOTION = 1.0
"""Minimum distance (metres) between positions that count as different."""
SEGMENTS = 8
"""Number of segments of a drive in which its scale is compared."""
MIN_SEGMENT_IMAGES = 4


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
    recorded_move = is_moving(given[model.placed])
    for _ in range(ROUNDS):
        source, scales = _scales(scene, images, model, job)
        outliers = scale_outliers(scales, limits.max_scale_drift)
        model, scales = model.without(outliers), scales[~outliers]
        drift = scale_drift(scales)
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
        scales = scales_from_lidar(scene, images, model, job.lidar)
        if enough_from_lidar(scales):
            return "LiDAR", scales
    recorded = np.stack([images.frames[i].camera_to_world for i in model.placed])
    scales = scales_from_positions(recorded, model)
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
    smooth = median_filter(scales[known], size=max(1, len(known) // SEGMENTS) | 1, mode="nearest")
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
    if not is_moving(recorded):
        return recorded[0] @ inverse(poses[0]) @ poses
    positions = [some[:, :3, 3] for some in (recorded, poses)]
    means = [some.mean(axis=0) for some in positions]
    by_position = (positions[0] - means[0]).T @ (positions[1] - means[1]) / priors.position**2
    by_rotation = np.einsum("nij,nkj->ik", recorded[:, :3, :3], poses[:, :3, :3]) / (2.0 * priors.tilt**2)
    u, _, vt = np.linalg.svd(by_position + by_rotation)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rigid(rotation, means[0] - rotation @ means[1]) @ poses


def scales_from_lidar(scene: Scene, images: RigImages, model: MappedImages, rays: LidarRays) -> np.ndarray:
    """Metres per unit (n,) of the model's images, NaN where too few of an image's points have LiDAR depth. Poses of
    images and sweeps are those of `scene`."""
    scales = np.full(len(model.placed), np.nan)
    for i, (placed, points) in enumerate(zip(model.placed, model.points, strict=True)):
        frame = scene.frames[images.indices[placed]]
        returns = nearest_returns(scene.sweeps, frame.timestamp, MAX_INTERVAL_US, rays.own_car_radius)
        if returns is None:
            continue
        k, world_to_camera = continuous_intrinsics(frame, (frame.width, frame.height)), inverse(frame.camera_to_world)
        shape = (frame.height, frame.width)
        index, rows, columns, depth = visible(returns, world_to_camera, k, shape)
        ranges = np.linalg.norm(returns[index] - frame.camera_to_world[:3, 3], axis=1)
        windows = patches(ranges, depth, k, rays.ray_spacing)
        front = unoccluded(rows, columns, depth, windows, shape)
        pixels, _ = project(returns[index[front]], world_to_camera, k)
        measured = depth_at(points.pixels, pixels, depth[front], windows[front].clip(MIN_WINDOW))
        known = np.isfinite(measured) & (points.depth > 0)
        if known.sum() >= MIN_DEPTHS:
            scales[i] = np.median(measured[known] / points.depth[known])
    return scales


def depth_at(queries: np.ndarray, pixels: np.ndarray, depth: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """Depth (n,) at `queries` (n, 2), interpolated between `pixels` (m, 2) with known `depth` (m,), NaN where none is
    within the median of `windows` (m, 2). Interpolates inverse depth, which is linear in pixels on a plane."""
    missing = np.full(len(queries), np.nan)
    if len(pixels) < MIN_DEPTHS or not len(queries):
        return missing
    cell = np.median(windows, axis=0)
    near = np.isfinite(cKDTree(pixels / cell).query(queries / cell, p=np.inf, distance_upper_bound=1.0)[0])
    try:
        return np.where(near, 1.0 / LinearNDInterpolator(pixels, 1.0 / depth)(queries), np.nan)
    except QhullError:  # all pixels on one line
        return missing


def scales_from_positions(recorded: np.ndarray, model: MappedImages) -> np.ndarray:
    """Metres per unit (n,) of the model's images: the distance covered within an eighth of the drive by the cameras
    `recorded` (n, 4, 4) over that in the model. NaN where the recorded ones do not move, and at the drive's end."""
    step = max(1, len(recorded) // SEGMENTS)
    metres, units = (
        np.linalg.norm(poses[step:, :3, 3] - poses[:-step, :3, 3], axis=1)
        for poses in (recorded, model.camera_to_model)
    )
    scales = np.full(len(recorded), np.nan)
    moved = np.flatnonzero((metres > MIN_MOTION) & (units > 0))
    scales[moved] = metres[moved] / units[moved]
    return scales


def enough_from_lidar(scales: np.ndarray) -> bool:
    """Whether enough images have a scale (n,) from LiDAR."""
    return bool(np.isfinite(scales).mean() >= MIN_LIDAR_FRACTION)


def scale_drift(scales: np.ndarray) -> float:
    """The factor by which scales (n,), in the order of time, change along a drive: the largest over the smallest median
    of its segments, without NaN."""
    known = scales[np.isfinite(scales)]
    segments = np.array_split(known, np.clip(len(known) // MIN_SEGMENT_IMAGES, 1, SEGMENTS))
    medians = [float(np.median(segment)) for segment in segments]
    return max(medians) / min(medians)


def scale_outliers(scales: np.ndarray, limit: float) -> np.ndarray:
    """Which images (n,) bool have scales (n,) that differ by more than the factor `limit` from the running median over
    a quarter of the drive: the mapper has misplaced them."""
    known = np.flatnonzero(np.isfinite(scales))
    around = median_filter(scales[known], size=len(known) // 4 | 1, mode="mirror")
    outliers = np.zeros(len(scales), dtype=bool)
    outliers[known] = np.abs(np.log(scales[known] / around)) > np.log(limit)
    return outliers


def is_moving(poses: np.ndarray) -> bool:
    """Whether poses (n, 4, 4) move; those of a drive without localisation do not."""
    return bool(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max() > MIN_MOTION)
