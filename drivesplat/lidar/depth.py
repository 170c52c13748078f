"""Depths of pixels from LiDAR: a sweep split into static and moving returns, and the returns that an image sees."""

from dataclasses import dataclass

import numpy as np

from drivesplat.lidar.coloring import visible
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.lidar.dynamic_objects import DynamicObject, dynamic_objects
from drivesplat.lidar.occlusion import patches, unhidden
from drivesplat.lidar.sweeps import returns_of
from drivesplat.scene.images import continuous_intrinsics, target_size
from drivesplat.scene.regions import fill, hulls_in
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.scene.splits import Group
from drivesplat.settings.lidar_depth import LidarDepthJob


@dataclass(frozen=True)
class Cloud:
    """A sweep taken apart: the sensor's place `origin` (3,), returns of the static world (n, 3) in world coordinates,
    and what moves, each with its returns (m, 3) in its own frame."""

    timestamp: int
    sample_index: int
    origin: np.ndarray
    static: np.ndarray
    dynamic: list[tuple[DynamicObject, np.ndarray]]


def clouds_of(scene: Scene, job: LidarDepthJob, groups: tuple[Group, ...]) -> list[Cloud]:
    """The key-frame sweeps of some groups, taken apart, in time order."""
    moving = dynamic_objects(scene)
    return [
        taken_apart(sweep, points, scene.seconds(sweep.timestamp), moving, job.box_margin)
        for sweep, points in returns_of(scene, job.holdout, job.own_car_radius, groups)
    ]


def taken_apart(sweep: Sweep, points: np.ndarray, seconds: float, moving: list[DynamicObject], margin: float) -> Cloud:
    """A sweep's returns (n, 3) in world coordinates, at its time in `seconds`; what may be road as well as wheel is
    left out."""
    static = np.ones(len(points), dtype=bool)
    for mover in moving:
        static &= ~mover.near(points, seconds, margin)
    own = [(mover, mover.own(points, seconds, margin)) for mover in moving]
    return Cloud(sweep.timestamp, sweep.sample_index, sweep.sensor_to_world[:3, 3], points[static], own)


def nearest_cloud(clouds: list[Cloud], timestamp: int, interval: float) -> Cloud | None:
    """The cloud nearest to a time (microseconds); None where none is within `interval`."""
    nearest = min(clouds, key=lambda cloud: abs(cloud.timestamp - timestamp), default=None)
    return nearest if nearest and abs(nearest.timestamp - timestamp) < interval else None


def depths_in(scene: Scene, frame: Frame, cloud: Cloud, job: LidarDepthJob, body: np.ndarray) -> PixelDepths:
    """The returns of a cloud that a frame sees, the nearest of a pixel. What is absent by then is left out, and so is
    what lies behind the own car's `body` (h, w) bool."""
    size, seconds = target_size(frame, job.images), scene.seconds(frame.timestamp)
    posed = [(mover.pose(seconds), own) for mover, own in cloud.dynamic]
    carried = [apply(pose, own) for pose, own in posed if pose is not None]
    points = np.concatenate([cloud.static, *carried])
    shape, intrinsics = (size[1], size[0]), continuous_intrinsics(frame, size)
    index, rows, columns, depth = visible(points, inverse(frame.camera_to_world), intrinsics, shape)
    ranges = np.linalg.norm(points[index] - cloud.origin, axis=1)
    front = unhidden(rows, columns, depth, patches(ranges, depth, intrinsics, job.ray_spacing), shape)
    index, rows, columns, depth = index[front], rows[front], columns[front], depth[front]
    boxes = box_depths(scene, frame, size, {mover.track.id for mover, _ in cloud.dynamic})
    kept = (index >= len(cloud.static)) | (depth < boxes[rows, columns])
    kept &= ~body[rows, columns]
    return nearest_per_pixel(np.column_stack([rows, columns, depth])[kept])


def box_depths(scene: Scene, frame: Frame, size: tuple[int, int], track_ids: set[str]) -> np.ndarray:
    """How near, in metres along the axis, the boxes of some tracks come in every pixel (h, w) of a frame; inf where
    there is none. LiDAR is too sparse to tell by its returns alone what a box hides that has moved since."""
    nearest = np.full((size[1], size[0]), np.inf)
    for hull in hulls_in(scene, frame, size):
        if hull.box.track_id in track_ids:
            corners = (hull.box.corners - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, 2]
            inside = fill(hull.polygon, size)
            nearest[inside] = np.minimum(nearest[inside], corners.min())
    return nearest


def nearest_per_pixel(found: np.ndarray) -> PixelDepths:
    """Rows, columns and depths (n, 3), of every pixel the nearest, row by row."""
    found = found[np.lexsort(found.T[::-1])]
    first = np.ones(len(found), dtype=bool)
    first[1:] = (np.diff(found[:, :2], axis=0) != 0).any(axis=1)
    rows, columns, depth = found[first].T
    return PixelDepths(rows.astype(np.int32), columns.astype(np.int32), depth.astype(np.float32))
