"""Objects on the street."""

from dataclasses import dataclass

import numpy as np

from drivesplat.world.shapes.body import Body, RigidBody
from drivesplat.world.shapes.mesh import ColoredMesh
from drivesplat.world.street.paths import ObjectPath, StreetPath

EGO_VEHICLE = "ego vehicle"
"""The part of the ego vehicle that cameras see."""
EGO_BODY = "ego body"
"""The whole ego vehicle, which only the LiDAR sees."""
EGO_PARTS = (EGO_VEHICLE, EGO_BODY)


@dataclass(frozen=True)
class StreetObject:
    """An object: its body, its path, and the seconds from which and until which it exists. nuScenes' `category` and
    `attribute` are None for scenery."""

    name: str
    body: Body
    path: ObjectPath
    category: str | None = None
    attribute: str | None = None
    begin: float = -np.inf
    end: float = np.inf

    def exists(self, seconds: np.ndarray) -> bool:
        """Whether it exists at any of `seconds` (n,)."""
        return bool(((seconds >= self.begin) & (seconds <= self.end)).any())

    @property
    def moves(self) -> bool:
        """Whether any of its pieces moves; limbs of a standing person do."""
        return self.path.moves or not isinstance(self.body, RigidBody)

    @property
    def size(self) -> np.ndarray:
        """Length, width and height (3,) of its annotated box."""
        return self.body.size

    def poses(self, seconds: np.ndarray) -> np.ndarray:
        """Object to street (n, 4, 4), its origin on the ground."""
        return self.path.poses(seconds)

    def piece_poses(self, seconds: np.ndarray) -> np.ndarray:
        """Piece to street (n, pieces, 4, 4)."""
        return self.poses(seconds)[:, None] @ self.limb_poses(seconds)

    def limb_poses(self, seconds: np.ndarray) -> np.ndarray:
        """Piece to object (n, pieces, 4, 4)."""
        return self.body.poses(self.path.distance(seconds), seconds)

    def box_poses(self, seconds: np.ndarray) -> np.ndarray:
        """Box centre to street (n, 4, 4)."""
        poses = self.poses(seconds).copy()
        poses[:, :3, 3] += poses[:, :3, 2] * self.size[2] / 2
        return poses


def fixed(name: str, mesh: ColoredMesh, path: ObjectPath | None = None) -> StreetObject:
    """A rigid object; without a path its mesh is in the street frame."""
    return StreetObject(name, RigidBody(mesh), path or StreetPath(0.0, 0.0))
