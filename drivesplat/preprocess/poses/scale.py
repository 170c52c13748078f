"""The scale of a model made from images, in metres per unit and per image: from LiDAR, or from recorded positions.

LiDAR gives the depth of the surfaces on which an image sees points. A sweep is placed by the ego pose at its own time,
up to 0.1 s from the image's.
"""

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import median_filter
from scipy.spatial import QhullError, cKDTree

from drivesplat.lidar.coloring import visible
from drivesplat.lidar.occlusion import patches, unoccluded
from drivesplat.lidar.sweeps import nearest_returns
from drivesplat.preprocess.poses.mapping import MappedImages
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import LidarRays

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
