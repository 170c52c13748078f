"""Ray casting on the street by Embree, each ray at its own time.

Objects that stand still share one Embree scene in the street frame. A moving piece has a scene in its own frame, into
which rays are transformed with the pose of the piece at their time. No scene is built twice.
"""

import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import NamedTuple, no_type_check

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene

from drivesplat.kernels.cache import kernel
from drivesplat.world.shapes.mesh import ColoredMesh
from drivesplat.world.street.objects import StreetObject

NO_HIT = -1
FACES_AT_ONCE = 50_000
"""Faces whose normals are computed at once, which bounds memory."""
SAMPLED_TIMES = 60
"""Number of times at which the extent of a body is measured."""


@dataclass(frozen=True)
class StreetRays:
    """n rays from a sensor that moves: unit `directions` (n, 3) in the street frame; `moment` (n,) int32 is the index
    of the ray's time among `seconds` (m,), at which the ray starts from `origins` (m, 3)."""

    seconds: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    moment: np.ndarray

    def __len__(self) -> int:
        return len(self.directions)


@dataclass(frozen=True)
class RayHits:
    """First hits of n rays: `distance` (n,) float64 metres, infinite without a hit; `object` (n,) int32, the object's
    index, NO_HIT without a hit; `face` (n,) among all faces; `normal` (n, 3) in the street frame, of any length and
    either sign; `weights` (n, 2): the barycentric coordinates of the face's second and third corner."""

    distance: np.ndarray
    object: np.ndarray
    face: np.ndarray
    normal: np.ndarray
    weights: np.ndarray


@cache
def embree_device(process: int) -> EmbreeDevice:
    """The Embree device of a process. All scenes share it: a process cannot hold a thousand. A forked process needs its
    own, since threads are not forked."""
    return EmbreeDevice()


class EmbreePiece:
    """Meshes in an Embree scene, in one frame; `owners` and `first_faces` are the object's index and the index of the
    first face among all faces, of each mesh."""

    def __init__(self, meshes: Sequence[ColoredMesh], owners: Sequence[int], first_faces: Sequence[int]):
        self.scene = EmbreeScene(embree_device(os.getpid()))
        self._triangles = [TriangleMesh(self.scene, mesh.triangles.astype(np.float32)) for mesh in meshes]
        self.owners, self.first_faces = np.array(owners, np.int32), np.array(first_faces)

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> dict[str, np.ndarray]:
        """Embree's hits of rays (n, 3) in the scene's frame."""
        return self.scene.run(origins.astype(np.float32), directions.astype(np.float32), output=True)

    def occluded(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether rays (n, 3) in the scene's frame hit anything: (n,) bool."""
        return self.scene.run(origins.astype(np.float32), directions.astype(np.float32), query="OCCLUDED") == 0


class Sphere(NamedTuple):
    """A sphere around what it bounds: `center` (3,) in metres, and radius."""

    center: np.ndarray
    radius: float

    def centers(self, poses: np.ndarray) -> np.ndarray:
        """The centres (m, 3) of the sphere at `poses` (m, 4, 4)."""
        return poses[:, :3, :3] @ self.center + poses[:, :3, 3]


@dataclass(frozen=True)
class MovingObject:
    """A moving object: its pieces, a sphere around each in the piece's frame, and one in the object's own frame that
    the pieces never leave."""

    item: StreetObject
    pieces: tuple[EmbreePiece, ...]
    spheres: tuple[Sphere, ...]
    sphere: Sphere


class RayCaster:
    """The meshes of all `objects`, ready to be hit at any time.

    `material` (f,), `color` (f, 3), `surface_class` (f,), `surface` (f,), `texture` (f, 3, 3) and `texture_normal`
    (f, 3) are those of all faces; textures and their normals are in metres of the mesh's own texture space.
    """

    def __init__(self, objects: Sequence[StreetObject]):
        self.objects = tuple(objects)
        meshes = [mesh for item in self.objects for mesh in item.body.pieces]
        first_faces = iter(np.cumsum([0, *(len(mesh.faces) for mesh in meshes)]).tolist())
        static: list[tuple[ColoredMesh, int, int]] = []
        self._moving = []
        for number, item in enumerate(self.objects):
            firsts = [next(first_faces) for _ in item.body.pieces]
            if item.moves:
                pieces = zip(item.body.pieces, firsts, strict=True)
                scenes = tuple(EmbreePiece([mesh], [number], [first]) for mesh, first in pieces)
                spheres = tuple(_bounding_sphere(mesh) for mesh in item.body.pieces)
                # a sphere in the object's frame around those of its pieces, at the times sampled
                center, radius = np.array([0.0, 0.0, item.size[2] / 2]), 0.0
                poses = item.body.poses(np.linspace(0.0, 6.0, SAMPLED_TIMES), np.linspace(0.0, 10.0, SAMPLED_TIMES))
                for piece, sphere in enumerate(spheres):
                    places = sphere.centers(poses[:, piece])
                    radius = max(radius, float(np.linalg.norm(places - center, axis=1).max()) + sphere.radius)
                self._moving.append(MovingObject(item, scenes, spheres, Sphere(center, 1.02 * radius)))
            else:
                poses = item.piece_poses(np.zeros(1))[0]
                placed = (mesh.transformed(pose) for mesh, pose in zip(item.body.pieces, poses, strict=True))
                static += [(mesh, number, first) for mesh, first in zip(placed, firsts, strict=True)]
        self._static = EmbreePiece(*zip(*static, strict=True)) if static else None
        self.material = np.concatenate([mesh.material for mesh in meshes])
        self.color = np.concatenate([mesh.color for mesh in meshes])
        self.surface_class = np.concatenate([mesh.surface_class for mesh in meshes])
        self.texture = np.empty((len(self.material), 3, 3))
        begin = 0
        for mesh in meshes:
            self.texture[begin : (begin := begin + len(mesh.faces))] = mesh.texture[mesh.faces]
        blocks = range(0, len(self.texture), FACES_AT_ONCE)
        self.texture_normal = np.concatenate([_normals(self.texture[at : at + FACES_AT_ONCE]) for at in blocks])
        # faces of one object, material, colour and direction are one surface
        owners = [number for number, item in enumerate(self.objects) for _ in item.body.pieces]
        owner = np.repeat(owners, [len(mesh.faces) for mesh in meshes])
        colors, normals = (255 * self.color).round().T, (8 * self.texture_normal).round().T
        key = np.zeros(len(owner), np.int64)
        for row in (owner, self.material, *colors, *normals):  # one by one, which takes less memory
            column = row.astype(np.int64)
            column -= column.min()
            key = key * (column.max() + 1) + column
        self.surface = np.unique(key, return_inverse=True)[1]

    def at(self, seconds: np.ndarray, without: Collection[str] = ()) -> "StreetSnapshot":
        """The street at the times `seconds` (m,), without the moving objects of these names."""
        return StreetSnapshot(self, seconds, without)


class StreetSnapshot:
    """The street at m times. A ray sees it at the time of its moment."""

    def __init__(self, caster: RayCaster, seconds: np.ndarray, without: Collection[str]):
        self.caster, self._seconds = caster, seconds
        self._moving = [
            (moving, moving.item.poses(seconds))
            for moving in caster._moving
            if moving.item.name not in without and moving.item.exists(seconds)
        ]
        self._piece_poses: dict[int, np.ndarray] = {}

    def _pieces(self, index: int) -> np.ndarray:
        """Piece to street (m, pieces, 4, 4) of a moving object; computed where it is first needed."""
        if index not in self._piece_poses:
            moving, poses = self._moving[index]
            self._piece_poses[index] = poses[:, None] @ moving.item.limb_poses(self._seconds)
        return self._piece_poses[index]

    def piece_poses(self) -> dict[str, np.ndarray]:
        """Piece to street (m, pieces, 4, 4) of each object that exists, by its name."""
        found = {moving.item.name: self._pieces(index) for index, (moving, _) in enumerate(self._moving)}
        static = (item for item in self.caster.objects if not item.moves)
        return found | {item.name: item.piece_poses(self._seconds) for item in static}

    def cast(self, rays: StreetRays) -> RayHits:
        """The first hit of each ray."""
        count = len(rays)
        hits = RayHits(
            np.full(count, np.inf), np.full(count, NO_HIT, np.int32), np.full(count, NO_HIT, np.int64),
            np.zeros((count, 3)), np.zeros((count, 2)),
        )  # fmt: skip
        if self.caster._static is not None:
            static = self.caster._static
            _keep_nearer(hits, static, static.intersect(rays.origins[rays.moment], rays.directions), np.arange(count))
        for piece, poses, chosen in self._near(rays.directions, rays.moment, rays.origins, per_ray=False):
            start, at = rays.origins[rays.moment[chosen]], rays.moment[chosen]
            origins, toward = _in_frame(poses[:, :3, :3], poses[:, :3, 3], at, start, rays.directions[chosen])
            _keep_nearer(hits, piece, piece.intersect(origins, toward), chosen, (poses, at))
        return hits

    def unoccluded(self, points: np.ndarray, direction: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Whether nothing lies beyond each of `points` (n, 3) along `direction` (3,), at the time of `moment` (n,):
        (n,) bool."""
        directions = np.ascontiguousarray(np.broadcast_to(direction, points.shape))
        free = np.ones(len(points), dtype=bool)
        if self.caster._static is not None:
            free &= ~self.caster._static.occluded(points, directions)
        for piece, poses, near in self._near(directions, moment, points, per_ray=True):
            chosen = near[free[near]]
            args = moment[chosen], points[chosen], directions[chosen]
            free[chosen] = ~piece.occluded(*_in_frame(poses[:, :3, :3], poses[:, :3, 3], *args))
        return free

    def _near(
        self, directions: np.ndarray, moment: np.ndarray, origins: np.ndarray, per_ray: bool
    ) -> Iterator[tuple[EmbreePiece, np.ndarray, np.ndarray]]:
        """Each moving piece that rays may hit, with its poses (m, 4, 4) to the street and the indices of these rays.
        `origins` are those of moments (m, 3), or of rays (n, 3) where `per_ray`."""
        passing = partial(_passing, directions, moment, origins, per_ray)
        every = np.arange(len(directions))
        for index, (moving, object_poses) in enumerate(self._moving):
            near = passing(every, moving.sphere.centers(object_poses), moving.sphere.radius**2)
            if not len(near):
                continue
            of_pieces = self._pieces(index)
            for number, (piece, sphere) in enumerate(zip(moving.pieces, moving.spheres, strict=True)):
                poses = of_pieces[:, number]
                chosen = passing(near, sphere.centers(poses), sphere.radius**2)
                if len(chosen):
                    yield piece, poses, chosen


def _normals(corners: np.ndarray) -> np.ndarray:
    """Unit normals (f, 3) of triangles with `corners` (f, 3, 3)."""
    edges = corners[:, 1:] - corners[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _bounding_sphere(mesh: ColoredMesh) -> Sphere:
    """A sphere around a mesh, with room for rounding."""
    center = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(mesh.vertices - center, axis=1).max())
    return Sphere(center, 1.001 * radius + 1e-3)


def _keep_nearer(
    hits: RayHits,
    piece: EmbreePiece,
    found: dict[str, np.ndarray],
    chosen: np.ndarray,
    to_street: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """Enters Embree's hits of the rays `chosen` (k,) that are nearer than those known. `to_street`: poses (m, 4, 4) of
    the piece's frame in the street, and which of them (k,) each ray meets; None if both frames are the same."""
    nearer = np.flatnonzero((found["geomID"] >= 0) & (found["tfar"] < hits.distance[chosen]))
    rows, geometry = chosen[nearer], found["geomID"][nearer]
    hits.distance[rows] = found["tfar"][nearer]
    hits.object[rows] = piece.owners[geometry]
    hits.face[rows] = found["primID"][nearer] + piece.first_faces[geometry]
    normals = found["Ng"][nearer]
    if to_street is not None:
        poses, at = to_street
        normals = np.einsum("nij,nj->ni", poses[at[nearer], :3, :3], normals)
    hits.normal[rows] = normals
    hits.weights[rows, 0], hits.weights[rows, 1] = found["u"][nearer], found["v"][nearer]


@kernel
@no_type_check
def _passing(directions, moment, origins, per_ray, among, centers, squared_radius):
    """Those of the rays `among` (k,), by index, that pass a sphere; its centre (m, 3) depends on the ray's moment."""
    chosen = np.empty(len(among), np.int64)
    count = 0
    for i in among:
        m = moment[i]
        source = i if per_ray else m
        x, y, z = (
            centers[m, 0] - origins[source, 0],
            centers[m, 1] - origins[source, 1],
            centers[m, 2] - origins[source, 2],
        )
        along = x * directions[i, 0] + y * directions[i, 1] + z * directions[i, 2]
        beside = x * x + y * y + z * z - (along * along if along > 0.0 else 0.0)
        if beside <= squared_radius:
            chosen[count] = i
            count += 1
    return chosen[:count].copy()


@kernel
@no_type_check
def _in_frame(rotations, positions, moment, origins, directions):
    """Origins and directions (n, 3) float32 of rays in a frame, whose `rotations` (m, 3, 3) and `positions` (m, 3)
    depend on the ray's moment."""
    starts, toward = np.zeros((len(moment), 3), np.float32), np.zeros((len(moment), 3), np.float32)
    for i in range(len(moment)):
        m = moment[i]
        for c in range(3):
            start = ray = 0.0
            for r in range(3):
                start += rotations[m, r, c] * (origins[i, r] - positions[m, r])
                ray += rotations[m, r, c] * directions[i, r]
            starts[i, c], toward[i, c] = start, ray
    return starts, toward
