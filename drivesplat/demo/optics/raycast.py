"""Ray casting on the street by Embree: first hits and occlusion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from drivesplat.demo.street import StreetObject
from drivesplat.scene.rigid import apply, inverse


@dataclass(frozen=True)
class RayHits:
    """First hits of n rays, in street coordinates: `distance` (n,) in metres, infinite without a hit; `object` (n,),
    the object's index, -1 without a hit; `face` (n,) among all faces; `normal` (n, 3) of any length and either sign."""

    distance: np.ndarray
    object: np.ndarray
    face: np.ndarray
    normal: np.ndarray


class EmbreeLayer:
    """The meshes of objects at a time, in an Embree scene."""

    def __init__(self, objects: Sequence[StreetObject], seconds: float):
        self.meshes = [item.mesh_at(seconds) for item in objects]
        self.poses = [item.path.pose_at(seconds) for item in objects]
        self.scene = EmbreeScene()
        self._triangles = [
            TriangleMesh(self.scene, apply(pose, mesh.triangles.reshape(-1, 3)).reshape(-1, 3, 3).astype(np.float32))
            for mesh, pose in zip(self.meshes, self.poses, strict=True)
        ]


class StreetSnapshot:
    """The street at a time. `poses`, `to_object` (objects, 4, 4): object to street and the inverse; `material` (f,) and
    `color` (f, 3) of all faces."""

    def __init__(self, objects: Sequence[StreetObject], seconds: float, static: EmbreeLayer | None = None):
        """`static`, which snapshots of all times share, holds the first of `objects`."""
        static = static or EmbreeLayer([], 0.0)
        moving = EmbreeLayer(objects[len(static.meshes) :], seconds)
        self._layers = [layer for layer in (static, moving) if layer.meshes]
        meshes = [mesh for layer in self._layers for mesh in layer.meshes]
        self.poses = np.array([pose for layer in self._layers for pose in layer.poses])
        self.to_object = inverse(self.poses)
        self._first_face = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])
        self.material = np.concatenate([mesh.material for mesh in meshes])
        self.color = np.concatenate([mesh.color for mesh in meshes])

    def cast(self, origin: np.ndarray, directions: np.ndarray) -> RayHits:
        """The first hits of rays from `origin` (3,) along unit vectors (n, 3)."""
        rays, count = directions.astype(np.float32), len(directions)
        origins = np.tile(origin.astype(np.float32), (count, 1))
        none = np.full(count, -1, dtype=np.int32)
        hits = RayHits(np.full(count, np.inf, np.float32), none, none.copy(), np.zeros((count, 3), np.float32))
        first = 0
        for layer in self._layers:
            found = layer.scene.run(origins, rays, output=True)
            nearer = np.flatnonzero((found["geomID"] >= 0) & (found["tfar"] < hits.distance))
            hits.distance[nearer], hits.normal[nearer] = found["tfar"][nearer], found["Ng"][nearer]
            hits.object[nearer] = found["geomID"][nearer] + first
            hits.face[nearer] = found["primID"][nearer] + self._first_face[hits.object[nearer]]
            first += len(layer.meshes)
        return hits

    def unoccluded(self, points: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Whether nothing lies beyond each of `points` (n, 3) along `direction` (3,): (n,) bool."""
        origins = points.astype(np.float32)
        directions = np.tile(direction.astype(np.float32), (len(origins), 1))
        free = [layer.scene.run(origins, directions, query="OCCLUDED") != 0 for layer in self._layers]
        return np.logical_and.reduce(free)
