"""Points on the surfaces of bodies, by which their visibility is counted."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from drivesplat.world.shapes.mesh import ColoredMesh

COUNT = 60
"""Points of a body."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the surface of a body of rigid pieces: the piece of each (n,), and its place (n, 3) in the piece's
    frame."""

    pieces: np.ndarray
    places: np.ndarray

    @classmethod
    def of(cls, meshes: Sequence[ColoredMesh]) -> "SurfacePoints":
        """COUNT points on a body of these pieces, spread evenly by area."""
        triangles = [mesh.triangles for mesh in meshes]
        pieces = np.repeat(np.arange(len(triangles)), [len(own) for own in triangles])
        corners = np.concatenate(triangles).reshape(-1, 3)
        mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
        places, faces = trimesh.sample.sample_surface(mesh, COUNT, seed=0)
        return cls(pieces[faces], np.asarray(places))

    def __len__(self) -> int:
        return len(self.pieces)

    def at(self, poses: np.ndarray) -> np.ndarray:
        """The points (n, 3) where the pieces have `poses` (pieces, 4, 4)."""
        return np.einsum("nij,nj->ni", poses[self.pieces, :3, :3], self.places) + poses[self.pieces, :3, 3]
