"""Rays against the street, by Embree: what they meet first, and whether the sun reaches it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from drivesplat.demo.bodies import Body
from drivesplat.demo.street import Thing
from drivesplat.scene.rigid import apply, inverse

FAR = 1e9


@dataclass(frozen=True)
class Hits:
    """What n rays met, in street coordinates.

    `distance` (n,) metres, over FAR for nothing; `thing` (n,), -1 for nothing; `face` (n,) among all faces; `normal`
    (n, 3) of any length, on either side.
    """

    distance: np.ndarray
    thing: np.ndarray
    face: np.ndarray
    normal: np.ndarray


class Stage:
    """Things at a moment, ready for rays.

    `to_body` (things, 4, 4) takes street coordinates to each thing's; `material` and `color` are those of all faces.
    """

    def __init__(self, things: Sequence[Thing], seconds: float, standing: "Layer | None" = None):
        """`standing` holds the first of the `things`, which do not move: it is built once for all moments."""
        standing = standing or Layer([], 0.0)
        moving = Layer(things[len(standing.bodies) :], seconds)
        self._layers = [layer for layer in (standing, moving) if layer.bodies]
        bodies = [body for layer in self._layers for body in layer.bodies]
        self.poses = np.array([pose for layer in self._layers for pose in layer.poses])
        self.to_body = inverse(self.poses)
        self._first_face = np.cumsum([0, *(len(body.faces) for body in bodies)])
        self.material = np.concatenate([body.material for body in bodies])
        self.color = np.concatenate([body.color for body in bodies])

    def meet(self, origin: np.ndarray, directions: np.ndarray) -> Hits:
        """What rays from a point (3,) along unit vectors (n, 3) meet first."""
        rays = directions.astype(np.float32)
        origins = np.tile(origin.astype(np.float32), (len(rays), 1))
        hits, first_thing = None, 0
        for layer in self._layers:
            met = layer.scene.run(origins, rays, output=True)
            if hits is None:
                nearer = slice(None)
                hits = Hits(met["tfar"], met["geomID"].copy(), met["primID"].copy(), met["Ng"])
            else:
                nearer = np.flatnonzero((met["geomID"] >= 0) & (met["tfar"] < hits.distance))
            thing = met["geomID"][nearer] + first_thing
            hits.distance[nearer], hits.normal[nearer] = met["tfar"][nearer], met["Ng"][nearer]
            hits.thing[nearer] = thing
            hits.face[nearer] = met["primID"][nearer] + self._first_face[np.maximum(thing, 0)]
            first_thing += len(layer.bodies)
        return hits

    def reached(self, points: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Whether light from `direction` (3,) comes to each of `points` (n, 3): (n,) bool."""
        origins = points.astype(np.float32)
        directions = np.tile(direction.astype(np.float32), (len(origins), 1))
        free = np.ones(len(origins), dtype=bool)
        for layer in self._layers:
            free &= layer.scene.run(origins, directions, query="OCCLUDED") != 0
        return free


class Layer:
    """Bodies in an Embree scene."""

    def __init__(self, things: Sequence[Thing], seconds: float):
        self.bodies: list[Body] = [thing.body_at(seconds) for thing in things]
        self.poses = [thing.motion.pose_at(seconds) for thing in things]
        self.scene = EmbreeScene()
        self._meshes = [
            TriangleMesh(self.scene, apply(pose, body.triangles.reshape(-1, 3)).reshape(-1, 3, 3).astype(np.float32))
            for body, pose in zip(self.bodies, self.poses, strict=True)
        ]
