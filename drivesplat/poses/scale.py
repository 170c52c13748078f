"""How many metres the unit of a model made from images is, image by image: by LiDAR, or by recorded positions.

LiDAR says how far off the surfaces are that an image sees points on. A sweep is placed by the car's poses at its own
time, which is up to 0.1 s from the image's.
"""

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import median_filter
from scipy.spatial import QhullError, cKDTree

from drivesplat.lidar.coloring import visible
from drivesplat.lidar.nearest_sweep import nearest_returns
from drivesplat.lidar.occlusion import patches, unhidden
from drivesplat.poses.mapping import Model, Sightings
from drivesplat.poses.rig import RigImages
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.refine_poses import LidarRays

WITHIN_US = 100_000.0
"""A sweep tells depths in images up to so many microseconds before and after it."""
MIN_DEPTHS = 10
"""An image has a scale of its own where LiDAR meets so many of its points."""
MIN_SHARE = 0.25
"""LiDAR tells a drive's scale where so large a share of the images has one."""
MIN_PIXELS = 2.0
"""A return counts at least so far around it."""
MOVES = 1.0
"""Positions that are farther apart than this (metres) are of a car that moves and was located."""
STRETCHES = 8
"""A drive is looked at in so many stretches for a drift of its scale,"""
MIN_IMAGES = 4
"""each of so many images at least."""


def by_lidar(scene: Scene, images: RigImages, model: Model, rays: LidarRays) -> np.ndarray:
    """Metres a unit (n,) of the model's images, NaN where LiDAR meets too few of an image's points; images and sweeps
    are where `scene` has them."""
    frames = [scene.frames[images.indices[i]] for i in model.placed]
    found = (depth_ratio(scene, frame, seen, rays) for frame, seen in zip(frames, model.sightings, strict=True))
    return np.array(list(found))


def depth_ratio(scene: Scene, frame: Frame, seen: Sightings, rays: LidarRays) -> float:
    """The median of LiDAR's depths over those of the points an image sees; NaN where there are too few."""
    points = nearest_returns(scene.sweeps, frame.timestamp, WITHIN_US, rays.own_car_radius)
    if points is None:
        return np.nan
    depth = depth_at(seen.pixels, *_returns_in(frame, points, rays))
    known = np.isfinite(depth) & (seen.depth > 0)
    return float(np.median(depth[known] / seen.depth[known])) if known.sum() >= MIN_DEPTHS else np.nan


def _returns_in(frame: Frame, points: np.ndarray, rays: LidarRays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The world points (n, 3) that an image sees: pixels (m, 2), depth (m,), and how far around them (m, 2), in pixels,
    they stand for the surface."""
    k, world_to_camera = continuous_intrinsics(frame, (frame.width, frame.height)), inverse(frame.camera_to_world)
    shape = (frame.height, frame.width)
    index, rows, columns, depth = visible(points, world_to_camera, k, shape)
    ranges = np.linalg.norm(points[index] - frame.camera_to_world[:3, 3], axis=1)
    halves = patches(ranges, depth, k, rays.ray_spacing)
    front = unhidden(rows, columns, depth, halves, shape)
    pixels, _ = project(points[index[front]], world_to_camera, k)
    return pixels, depth[front], halves[front].clip(MIN_PIXELS)


def depth_at(wanted: np.ndarray, pixels: np.ndarray, depth: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Depth (n,) at the pixels `wanted` (n, 2) between those (m, 2) where it is known (m,), NaN where none of them is
    within its `reach` (m, 2). What is linear in pixels on a plane is depth's inverse."""
    if len(pixels) < MIN_DEPTHS or not len(wanted):
        return np.full(len(wanted), np.nan)
    cell = np.median(reach, axis=0)
    near = np.isfinite(cKDTree(pixels / cell).query(wanted / cell, p=np.inf, distance_upper_bound=1.0)[0])
    try:
        between = LinearNDInterpolator(pixels, 1.0 / depth)(wanted)
    except QhullError:  # they lie on one line
        return np.full(len(wanted), np.nan)
    return np.where(near, 1.0 / between, np.nan)


def by_positions(recorded: np.ndarray, model: Model) -> np.ndarray:
    """Metres a unit (n,) of the model's images, by how far their cameras `recorded` (n, 4, 4) and the model's are from
    those an eighth of the drive later; NaN where the recorded ones do not move, or the drive ends before."""
    ahead = max(1, len(recorded) // STRETCHES)
    apart = [np.linalg.norm(poses[ahead:, :3, 3] - poses[:-ahead, :3, 3], axis=1)
             for poses in (recorded, model.camera_to_model)]  # fmt: skip
    scales = np.full(len(recorded), np.nan)
    moved = (apart[0] > MOVES) & (apart[1] > 0)
    scales[: len(moved)][moved] = apart[0][moved] / apart[1][moved]
    return scales


def told_by_lidar(scales: np.ndarray) -> bool:
    """Whether enough images have a scale (n,) for the drive to have one."""
    return bool(np.isfinite(scales).mean() >= MIN_SHARE)


def drift(scales: np.ndarray) -> float:
    """By which factor scales (n,), in the order of time, change along a drive: the largest over the smallest median of
    its stretches. Those that are NaN do not count."""
    known = scales[np.isfinite(scales)]
    stretches = np.array_split(known, np.clip(len(known) // MIN_IMAGES, 1, STRETCHES))
    medians = [float(np.median(stretch)) for stretch in stretches]
    return max(medians) / min(medians)


def strays(scales: np.ndarray, limit: float) -> np.ndarray:
    """Which images (n,) bool have scales (n,) that differ from those around them, the running median over a quarter of
    the drive, by more than a factor: the mapper has misplaced them."""
    known = np.flatnonzero(np.isfinite(scales))
    around = median_filter(scales[known], size=len(known) // 4 | 1, mode="mirror")
    result = np.zeros(len(scales), dtype=bool)
    result[known] = np.abs(np.log(scales[known] / around)) > np.log(limit)
    return result


def moves(poses: np.ndarray) -> bool:
    """Whether poses (n, 4, 4) are of something that moves: those of a car that nobody located stand still."""
    return bool(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max() > MOVES)
