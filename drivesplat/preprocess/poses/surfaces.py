"""Surfaces that a LiDAR sweep met, and how far another sweep lies from them.

A static surface that two sweeps see lies at one place in the world if their poses are right. The distance of a return
of one sweep to the plane of the nearest surface point of the other is therefore a measure of poses that images have no
part in.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from drivesplat.errors import DatasetError
from drivesplat.lidar.sweeps import outside_boxes, thin, without_ego_vehicle
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.rigid import apply
from drivesplat.scene.scene import Scene, Sweep
from drivesplat.scene.tracks import boxes_at

FINE, COARSE = 0.12, 0.3
"""Edges in metres of the voxels that keep one return each: as a neighbour of others, and as a point of a surface."""
MAX_RANGE = 70.0
"""Metres from the sensor beyond which returns are too sparse for a plane."""
NEIGHBOURS = 14
"""Number of nearest returns that a plane is fitted to."""
MAX_SPREAD = 1.0
"""Metres from the return within which all of them lie."""
MAX_THICKNESS, MIN_WIDTH = 0.2, 0.2
"""A plane's smallest standard deviation relative to its middle one, and the middle one relative to its largest: not a
bush, and not the trace of a single beam."""
UPRIGHT = 0.3
"""Upward component of the normal of a surface below which it is upright."""
BOX_MARGIN = 0.3
"""Metres around boxes within which returns are not static."""


@dataclass(frozen=True)
class Surfaces:
    """Points (n, 3) of a sweep on smooth surfaces, in metres in the sensor's frame, and their unit normals (n, 3)."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)

    def __len__(self) -> int:
        return len(self.points)

    def sampled(self, count: int) -> "Surfaces":
        """At most `count` of the points, evenly spread."""
        if len(self) <= count:
            return self
        chosen = np.linspace(0, len(self) - 1, count).astype(int)
        return self._where(chosen)

    def split(self, to_world: np.ndarray) -> tuple["Surfaces", "Surfaces"]:
        """The points on upright surfaces, and all others, by the pose (4, 4) of their frame in the world."""
        upright = np.abs(self.normals @ to_world[2, :3]) < UPRIGHT
        return self._where(upright), self._where(~upright)

    def moved(self, transform: np.ndarray) -> "Surfaces":
        """The same in the frame that a rigid transform (4, 4) leads to."""
        return Surfaces(apply(transform, self.points), self.normals @ transform[:3, :3].T)

    def _where(self, chosen: np.ndarray) -> "Surfaces":
        return Surfaces(self.points[chosen], self.normals[chosen])


NOTHING = Surfaces(np.zeros((0, 3)), np.zeros((0, 3)))


def surfaces_of(scene: Scene, sweep: Sweep, own_car_radius: float) -> Surfaces:
    """The surfaces of a sweep outside boxes of moving objects; none where its file is missing or corrupt."""
    try:
        points = without_ego_vehicle(read_returns(sweep).points, own_car_radius)
    except DatasetError:
        return NOTHING
    points = points[np.linalg.norm(points, axis=1) < MAX_RANGE]
    boxes = [box for box in boxes_at(scene, sweep.timestamp) if box.moves]
    points = points[outside_boxes(apply(sweep.sensor_to_world, points), boxes, BOX_MARGIN)]
    points = points[thin(points, FINE)]
    if len(points) < NEIGHBOURS:
        return NOTHING
    chosen = points[thin(points, COARSE)]
    distances, near = cKDTree(points).query(chosen, k=NEIGHBOURS)
    offsets = points[near] - points[near].mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets) / NEIGHBOURS)
    deviations = np.sqrt(np.maximum(variances, 0.0))
    smooth = (
        (distances[:, -1] < MAX_SPREAD)
        & (deviations[:, 0] < MAX_THICKNESS * deviations[:, 1])
        & (deviations[:, 1] > MIN_WIDTH * deviations[:, 2])
    )
    return Surfaces(chosen[smooth], axes[smooth, :, 0])
