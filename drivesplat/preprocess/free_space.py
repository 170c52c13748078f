"""The stage `free_space`: the voxels that rays prove empty of static surfaces.

A ray from a sensor to its end point proves that the space between is empty at that time, and so never holds a static
surface. A voxel is empty if enough rays pass through it, and

- neither it nor any of its 26 neighbours holds the end of a ray: objects thinner than a voxel (a pole, a branch) stop
  some rays only;
- rays also pass through its six face neighbours: a surface seen at a grazing angle lies in voxels that rays traverse
  long before they end, but no ray traverses the voxels behind it.

The rays are those of LiDAR, and those from training images to the points that pose refinement has triangulated.

A ray that ends on a dynamic object proves its path empty like any other, but does not make its end occupied: the object
moves on. Held-out sweeps contribute nothing.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivesplat.errors import ConfigError
from drivesplat.lidar.dynamic_objects import dynamic_objects
from drivesplat.lidar.free_space_record import FreeSpace
from drivesplat.lidar.sweeps import returns_of
from drivesplat.lidar.traversal import OCCUPIED, count_passing, empty_voxels
from drivesplat.poses.triangulated import TriangulatedPoints
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import training_images
from drivesplat.settings.free_space import FreeSpaceJob, FreeSpaceSettings

log = logging.getLogger(__name__)

MAX_VOXELS = 2**31
"""Maximum number of voxels of a grid; building it takes one byte per voxel."""


@dataclass(frozen=True)
class Rays:
    """Rays from `origins` (r, 3) to `ends` (r, 3) in world metres; `static` (r,) bool: whether a ray ends on a static
    surface."""

    origins: np.ndarray
    ends: np.ndarray
    static: np.ndarray

    @classmethod
    def joined(cls, several: Sequence["Rays"]) -> "Rays":
        """Concatenates `several`."""
        none = cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, dtype=bool))
        columns = zip(*((rays.origins, rays.ends, rays.static) for rays in (none, *several)), strict=True)
        return cls(*map(np.concatenate, columns))


def free_space_record(scene: Scene, job: FreeSpaceJob, triangulated: TriangulatedPoints | None = None) -> FreeSpace:
    """The free space of a scene, without provenance, from its LiDAR and, if given, its triangulated points."""
    rays = Rays.joined([lidar_rays(scene, job), *([camera_rays(scene, job, triangulated)] if triangulated else [])])
    record = proven_empty(rays, job.free_space)
    log.info("%d rays mark %.0f cubic metres as empty", len(rays.ends), len(record.keys) * record.voxel**3)
    return record


def lidar_rays(scene: Scene, job: FreeSpaceJob) -> Rays:
    """The rays of the training sweeps, from each sweep's sensor; returns of the ego vehicle are left out."""
    objects, rays = dynamic_objects(scene), []
    for sweep, points in returns_of(scene, job.holdout, job.own_car_radius):
        static = np.ones(len(points), dtype=bool)
        for item in objects:
            static &= ~item.near(points, scene.seconds(sweep.timestamp), job.box_margin)
        origins = np.broadcast_to(sweep.sensor_to_world[:3, 3], points.shape)
        rays.append(Rays(origins, points, static))
    return Rays.joined(rays)


def camera_rays(scene: Scene, job: FreeSpaceJob, triangulated: TriangulatedPoints) -> Rays:
    """The rays from the training images to the triangulated points that they see, if enough of them see a point. All
    points are static: features on dynamic objects are excluded before triangulation."""
    training = training_images(scene, job.holdout)
    counts = np.isin(triangulated.seen_by, training) & triangulated.seen_in(training)[triangulated.seen_point]
    centres = np.stack([frame.camera_to_world[:3, 3] for frame in scene.frames])
    ends = triangulated.points[triangulated.seen_point[counts]]
    return Rays(centres[triangulated.seen_by[counts]], ends, np.ones(len(ends), dtype=bool))


def proven_empty(rays: Rays, settings: FreeSpaceSettings) -> FreeSpace:
    """The space that rays prove empty.

    Raises ConfigError where the grid would have more than MAX_VOXELS.
    """
    starts, ends = proving(rays, settings)
    lower, shape = _bounds(np.concatenate([starts, ends]), settings.voxel)
    if shape.prod(dtype=np.float64) > MAX_VOXELS:
        raise ConfigError(
            f"free_space: a grid of {' x '.join(map(str, shape))} voxels is too large; "
            "raise free_space.voxel or lower free_space.range"
        )
    counts = np.zeros(tuple(shape), dtype=np.uint8)
    count_passing(counts, (starts - lower) / settings.voxel, (ends - lower) / settings.voxel)
    cells = np.floor((rays.ends[rays.static] - lower) / settings.voxel)
    occupied = cells[((cells >= 0) & (cells < shape)).all(axis=1)].astype(np.int64)
    counts[tuple(occupied.T)] = OCCUPIED
    keys = empty_voxels(counts, settings.min_rays)
    return FreeSpace(lower, shape, settings.voxel, keys)


def proving(rays: Rays, settings: FreeSpaceSettings) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends (p, 3) of the segments that rays prove empty: within `settings.range` of their origins, and with
    a margin before their ends."""
    along = rays.ends - rays.origins
    length = np.linalg.norm(along, axis=1)
    reach = np.minimum(length * (1.0 - settings.margin_share) - settings.margin, settings.range)
    proves = reach > 0
    fraction = (reach[proves] / length[proves])[:, None]
    return rays.origins[proves], rays.origins[proves] + fraction * along[proves]


def _bounds(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """The lower corner (3,) in metres and the shape (3,) in voxels of a grid around world points (n, 3), with a border
    of two voxels, where no voxel can be proven empty. The voxels are aligned to multiples of their edge."""
    if len(points) == 0:
        return np.zeros(3), np.ones(3, dtype=np.int64)
    first = np.floor(points.min(axis=0) / voxel) - 2.0
    last = np.floor(points.max(axis=0) / voxel) + 2.0
    return first * voxel, (last - first + 1.0).astype(np.int64)
