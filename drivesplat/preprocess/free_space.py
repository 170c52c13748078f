"""The stage `free_space`: where nothing stands, since rays went through.

A ray from a sensor to what it met proves the space between empty, at that moment, and so at all times of what stands
still. Space is told in voxels. One is empty if enough rays passed it, and

- neither it nor one of the 26 around it holds the end of a ray: what is thinner than a voxel (a pole, a branch) ends
  some rays and lets others pass;
- rays passed the six voxels at its faces, too: a surface seen at a grazing angle lies in voxels that rays pass long
  before they end, and the voxels behind it are passed by none.

Rays are LiDAR's, and those from training images to the points that the refinement of poses has triangulated.

A ray that ends on something that moves proves as much as any other, but its end is no occupancy: the place is empty
again. Held-out sweeps contribute nothing.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivesplat.errors import ConfigError
from drivesplat.lidar.dynamic_objects import dynamic_objects
from drivesplat.lidar.free_space_record import FreeSpace
from drivesplat.lidar.sweeps import training_returns
from drivesplat.lidar.traversal import OCCUPIED, count_passing, empty_voxels
from drivesplat.poses.triangulated import TriangulatedPoints
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import training_images
from drivesplat.settings.free_space import FreeSpaceJob, FreeSpaceSettings

log = logging.getLogger(__name__)

MAX_VOXELS = 2**31
"""A grid of more (a byte each while it is made) is refused."""


@dataclass(frozen=True)
class Rays:
    """Rays from `origins` (r, 3) to what they met at `ends` (r, 3), world metres; `static` (r,) bool: whether that
    is static."""

    origins: np.ndarray
    ends: np.ndarray
    static: np.ndarray

    @classmethod
    def joined(cls, several: Sequence["Rays"]) -> "Rays":
        """All of `several` as one."""
        origins, ends = (np.concatenate([np.empty((0, 3)), *(getattr(r, of) for r in several)]) for of in _PLACES)
        return cls(origins, ends, np.concatenate([np.empty(0, dtype=bool), *(r.static for r in several)]))


_PLACES = ("origins", "ends")


def free_space_record(scene: Scene, job: FreeSpaceJob, triangulated: TriangulatedPoints | None = None) -> FreeSpace:
    """The free space of a scene, without provenance, from its LiDAR and, where they are given, triangulated points."""
    rays = Rays.joined([lidar_rays(scene, job), *([camera_rays(scene, job, triangulated)] if triangulated else [])])
    record = proven_empty(rays, job.free_space)
    log.info("%d rays prove %.0f cubic metres empty", len(rays.ends), len(record.keys) * record.voxel**3)
    return record


def lidar_rays(scene: Scene, job: FreeSpaceJob) -> Rays:
    """The rays of the training sweeps, each from its sweep's own sensor; the own car's returns are left out."""
    moving, found = dynamic_objects(scene), []
    for sweep, points in training_returns(scene, job.holdout, job.own_car_radius):
        static = np.ones(len(points), dtype=bool)
        for mover in moving:
            static &= ~mover.near(points, scene.seconds(sweep.timestamp), job.box_margin)
        origins = np.broadcast_to(sweep.sensor_to_world[:3, 3], points.shape)
        found.append(Rays(origins, points, static))
    return Rays.joined(found)


def camera_rays(scene: Scene, job: FreeSpaceJob, triangulated: TriangulatedPoints) -> Rays:
    """The rays from the training images to the triangulated points that they see, if enough of them see a point. All
    stand still: features on what moves are left out before anything is triangulated."""
    training = training_images(scene, job.holdout)
    counts = np.isin(triangulated.seen_by, training) & triangulated.seen_in(training)[triangulated.seen_point]
    centres = np.stack([frame.camera_to_world[:3, 3] for frame in scene.frames])
    ends = triangulated.points[triangulated.seen_point[counts]]
    return Rays(centres[triangulated.seen_by[counts]], ends, np.ones(len(ends), dtype=bool))


def proven_empty(rays: Rays, settings: FreeSpaceSettings) -> FreeSpace:
    """What rays of any kind prove empty.

    Raises ConfigError where the grid would be too large.
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
    """Starts and ends (p, 3) of what rays prove: not their last metres, nor what is far from where they start."""
    along = rays.ends - rays.origins
    length = np.linalg.norm(along, axis=1)
    reach = np.minimum(length * (1.0 - settings.margin_share) - settings.margin, settings.range)
    proves = reach > 0
    fraction = (reach[proves] / length[proves])[:, None]
    return rays.origins[proves], rays.origins[proves] + fraction * along[proves]


def _bounds(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """The lower corner (3,) in metres and the number of voxels (3,) of a grid that holds world points (n, 3), with two
    voxels to spare: at its border nothing is told. Its voxels lie on multiples of their edge."""
    if len(points) == 0:
        return np.zeros(3), np.ones(3, dtype=np.int64)
    first = np.floor(points.min(axis=0) / voxel) - 2.0
    last = np.floor(points.max(axis=0) / voxel) + 2.0
    return first * voxel, (last - first + 1.0).astype(np.int64)
