"""The stage `lidar_depth`: how far from the camera the surfaces in every training image are, where LiDAR met them.

An image sees the returns of the training sweep nearest to it in time. What moves has gone on since: its returns go with
its box. Held-out sweeps contribute nothing, and held-out images get nothing.
"""

import logging
from dataclasses import dataclass

import numpy as np

from drivesplat.holdout import frame_groups
from drivesplat.images import continuous_intrinsics, target_size
from drivesplat.own_car import NOWHERE, OwnCar
from drivesplat.regions import fill, hulls_in
from drivesplat.rigid import apply, inverse
from drivesplat.scene import Frame, Scene
from drivesplat.seeding.coloring import visible
from drivesplat.seeding.movers import Mover, movers
from drivesplat.seeding.sweeps import training_returns
from drivesplat.settings.lidar_depth import LidarDepthJob

log = logging.getLogger(__name__)

Depths = dict[str, np.ndarray]
"""`rows` and `columns` (m,) int32 of pixels, `depth` (m,) float32 metres."""


@dataclass(frozen=True)
class Cloud:
    """A sweep taken apart: returns of what stands still (n, 3) in world coordinates, and what moves, each with its
    returns (m, 3) in its own frame."""

    timestamp: int
    still: np.ndarray
    moving: list[tuple[Mover, np.ndarray]]


def lidar_depths(scene: Scene, job: LidarDepthJob, own_car: OwnCar = NOWHERE) -> list[Depths]:
    """What LiDAR says of each of the scene's frames, the own car's body left out; nothing of those that no training
    sees."""
    moving = movers(scene)
    clouds = [
        taken_apart(points, sweep.timestamp, scene.seconds(sweep.timestamp), moving, job.box_margin)
        for sweep, points in training_returns(scene, job.holdout, job.own_car_radius)
    ]
    images = []
    for frame, group in zip(scene.frames, frame_groups(scene, job.holdout), strict=True):
        cloud = nearest_cloud(clouds, frame.timestamp, scene.key_frame_interval) if group == "train" else None
        images.append(depths_in(scene, frame, cloud, job, own_car) if cloud else _depths(np.empty((0, 3))))
    known = [len(image["depth"]) for image in images if len(image["depth"])]
    log.info("%d depths in %d of %d images", sum(known), len(known), len(images))
    return images


def taken_apart(points: np.ndarray, timestamp: int, seconds: float, moving: list[Mover], margin: float) -> Cloud:
    """The world points (n, 3) of a sweep at a time; what may be road as well as wheel is left out."""
    still = np.ones(len(points), dtype=bool)
    for mover in moving:
        still &= ~mover.near(points, seconds, margin)
    own = [(mover, mover.own(points, seconds, margin)) for mover in moving]
    return Cloud(timestamp, points[still], own)


def nearest_cloud(clouds: list[Cloud], timestamp: int, interval: float) -> Cloud | None:
    """The cloud nearest to a time (microseconds); None where none is within `interval`."""
    nearest = min(clouds, key=lambda cloud: abs(cloud.timestamp - timestamp), default=None)
    return nearest if nearest and abs(nearest.timestamp - timestamp) < interval else None


def depths_in(scene: Scene, frame: Frame, cloud: Cloud, job: LidarDepthJob, own_car: OwnCar) -> Depths:
    """The returns of a cloud that a frame sees, the nearest of a pixel. What is absent by then is left out."""
    size, seconds = target_size(frame, job.images), scene.seconds(frame.timestamp)
    posed = [(mover.pose(seconds), own) for mover, own in cloud.moving]
    carried = [apply(pose, own) for pose, own in posed if pose is not None]
    points = np.concatenate([cloud.still, *carried])
    camera = inverse(frame.camera_to_world), continuous_intrinsics(frame, size)
    index, rows, columns, depth = visible(points, *camera, (size[1], size[0]))
    boxes = box_depths(scene, frame, size, {mover.track.id for mover, _ in cloud.moving})
    kept = (index >= len(cloud.still)) | (depth < boxes[rows, columns])
    kept &= ~own_car.pixels(frame.camera, size)[rows, columns]
    return _depths(np.column_stack([rows, columns, depth])[kept])


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


def _depths(found: np.ndarray) -> Depths:
    """Rows, columns and depths (n, 3), of every pixel the nearest, row by row."""
    found = found[np.lexsort(found.T[::-1])]
    first = np.ones(len(found), dtype=bool)
    first[1:] = (np.diff(found[:, :2], axis=0) != 0).any(axis=1)
    rows, columns, depth = found[first].T
    return {"rows": rows.astype(np.int32), "columns": columns.astype(np.int32), "depth": depth.astype(np.float32)}
