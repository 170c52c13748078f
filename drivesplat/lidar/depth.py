"""Pixel depths from LiDAR: sweeps split into static and dynamic returns, and their projection into images."""

from dataclasses import dataclass

import numpy as np

from drivesplat.lidar.coloring import visible
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.lidar.dynamic_objects import DynamicObject, dynamic_objects
from drivesplat.lidar.occlusion import patches, unoccluded
from drivesplat.lidar.sweeps import returns_of
from drivesplat.scene.images import continuous_intrinsics, target_size
from drivesplat.scene.recorded_shutters import shutter_of
from drivesplat.scene.regions import fill, hulls_in
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.scene.shutter import where_seen
from drivesplat.scene.splits import Group
from drivesplat.settings.lidar_depth import LidarDepthJob


@dataclass(frozen=True)
class Cloud:
    """A split sweep: the sensor's position `origin` (3,), static returns (n, 3) in world coordinates, and dynamic
    objects, each with its returns (m, 3) in its own frame."""

    timestamp: int
    sample_index: int
    origin: np.ndarray
    static: np.ndarray
    dynamic: list[tuple[DynamicObject, np.ndarray]]


def split_sweeps(scene: Scene, job: LidarDepthJob, groups: tuple[Group, ...]) -> list[Cloud]:
    """Splits the sweeps of the given groups into static and dynamic returns, in time order."""
    objects = dynamic_objects(scene)
    return [
        split_sweep(sweep, points, scene.seconds(sweep.timestamp), objects, job.box_margin)
        for sweep, points in returns_of(scene, job.holdout, job.own_car_radius, groups)
    ]


def split_sweep(sweep: Sweep, points: np.ndarray, seconds: float, objects: list[DynamicObject], margin: float) -> Cloud:
    """Splits a sweep's returns (n, 3) in world coordinates at its time in `seconds`. Drops returns that may belong to
    the road as well as to an object."""
    static = np.ones(len(points), dtype=bool)
    for item in objects:
        static &= ~item.near(points, seconds, margin)
    dynamic = [(item, item.own(points, seconds, margin)) for item in objects]
    return Cloud(sweep.timestamp, sweep.sample_index, sweep.sensor_to_world[:3, 3], points[static], dynamic)


def depths_in(scene: Scene, frame: Frame, cloud: Cloud, job: LidarDepthJob, body: np.ndarray) -> PixelDepths:
    """The nearest return of a cloud at each pixel of a frame. Returns of objects that are absent at the frame's time,
    and pixels of the ego vehicle's `body` (h, w) bool, are left out."""
    size, seconds = target_size(frame, job.images), scene.seconds(frame.timestamp)
    posed = [(item, item.pose(seconds), returns) for item, returns in cloud.dynamic]
    dynamic = [(item, returns, apply(pose, returns)) for item, pose, returns in posed if pose is not None]
    points = np.concatenate([cloud.static, *(moved for *_, moved in dynamic)])
    shape, intrinsics = (size[1], size[0]), continuous_intrinsics(frame, size)
    shown, shutter = points, shutter_of(scene, frame)
    if shutter is not None:
        own = [item.velocities(returns, seconds) for item, returns, _ in dynamic]
        velocities = np.concatenate([np.zeros_like(cloud.static), *own])
        shown = where_seen(points, shutter, frame.camera_to_world, intrinsics, size, velocities)
    index, rows, columns, depth = visible(shown, inverse(frame.camera_to_world), intrinsics, shape)
    ranges = np.linalg.norm(points[index] - cloud.origin, axis=1)
    front = unoccluded(rows, columns, depth, patches(ranges, depth, intrinsics, job.ray_spacing), shape)
    index, rows, columns, depth = index[front], rows[front], columns[front], depth[front]
    # Static returns behind the box of a moved object are occluded: its own returns are too sparse to decide that.
    boxes, moved_ids = np.full(shape, np.inf), {item.track.id for item, _ in cloud.dynamic}
    for hull in hulls_in(scene, frame, size):
        if hull.box.track_id in moved_ids:
            corners = (hull.box.corners - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, 2]
            inside = fill(hull.polygon, size)
            boxes[inside] = np.minimum(boxes[inside], corners.min())
    kept = (index >= len(cloud.static)) | (depth < boxes[rows, columns])
    kept &= ~body[rows, columns]
    return nearest_per_pixel(np.column_stack([rows, columns, depth])[kept])


def nearest_per_pixel(found: np.ndarray) -> PixelDepths:
    """The nearest depth of every pixel among rows, columns and depths (n, 3), in row-major order."""
    found = found[np.lexsort(found.T[::-1])]
    first = np.ones(len(found), dtype=bool)
    first[1:] = (np.diff(found[:, :2], axis=0) != 0).any(axis=1)
    rows, columns, depth = found[first].T
    return PixelDepths(rows.astype(np.int32), columns.astype(np.int32), depth.astype(np.float32))
