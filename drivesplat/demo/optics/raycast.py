"""Ray casting on the street by Embree, each ray at its own time.

Objects that stand still share one Embree scene in the street frame. A moving piece has a scene in its own frame, into
which rays are transformed with the pose of the piece at their time. No scene is built twice.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from drivesplat.demo.shapes.mesh import ColoredMesh
from drivesplat.demo.street.objects import StreetObject
from drivesplat.kernels.cache import kernel
from drivesplat.scene.rigid import apply, inverse

NO_HIT = -1


@dataclass(frozen=True)
class Rays:
    """n rays from a sensor that moves: unit `directions` (n, 3) in the street frame; `moment` (n,) int32 is the index
    of the ray's time among `seconds` (m,), at which the ray starts from `origins` (m, 3)."""

    seconds: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    moment: np.ndarray

    def __len__(self) -> int:
        return len(self.directions)

    def starts(self) -> np.ndarray:
        """Origins (n, 3)."""
        return self.origins[self.moment]

    def points(self, distance: np.ndarray) -> np.ndarray:
        """The points (n, 3) at `distance` (n,) along each ray; those without a hit lie at the origin."""
        return self.starts() + np.where(np.isfinite(distance), distance, 0.0)[:, None] * self.directions


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


class EmbreePiece:
    """Meshes in an Embree scene, in one frame. `faces`: index of each mesh's first face among all faces."""

    def __init__(self, meshes: Sequence[ColoredMesh], owners: Sequence[int], first_faces: Sequence[int]):
        self.scene = EmbreeScene()
        self._triangles = [TriangleMesh(self.scene, mesh.triangles.astype(np.float32)) for mesh in meshes]
        self.owners, self.first_faces = np.array(owners, np.int32), np.array(first_faces)
        spheres = [mesh.bounding_sphere for mesh in meshes]
        self.center, self.radius = spheres[0] if len(spheres) == 1 else (np.zeros(3), np.inf)

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> dict[str, np.ndarray]:
        """Embree's hits of rays (n, 3) in the scene's frame."""
        return self.scene.run(origins.astype(np.float32), directions.astype(np.float32), output=True)

    def occluded(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether rays (n, 3) in the scene's frame hit anything: (n,) bool."""
        return self.scene.run(origins.astype(np.float32), directions.astype(np.float32), query="OCCLUDED") == 0


class RayCaster:
    """The meshes of all `objects`, ready to be hit at any time.

    `material` (f,), `color` (f, 3), `surface_class` (f,), `texture` (f, 3, 3) and `texture_normal` (f, 3) are those of
    all faces; textures and their normals are in metres of the mesh's own texture space.
    """

    def __init__(self, objects: Sequence[StreetObject]):
        self.objects = tuple(objects)
        meshes: list[ColoredMesh] = []
        self._moving: list[tuple[int, int, EmbreePiece]] = []
        static, owners, firsts, count = [], [], [], 0
        for number, item in enumerate(self.objects):
            for piece, mesh in enumerate(item.body.pieces):
                if item.moves:
                    self._moving.append((number, piece, EmbreePiece([mesh], [number], [count])))
                else:
                    static.append(mesh.transformed(item.piece_poses(np.zeros(1))[0, piece]))
                    owners.append(number)
                    firsts.append(count)
                meshes.append(mesh)
                count += len(mesh.faces)
        self._static = EmbreePiece(static, owners, firsts) if static else None
        self.material = np.concatenate([mesh.material for mesh in meshes])
        self.color = np.concatenate([mesh.color for mesh in meshes])
        self.surface_class = np.concatenate([mesh.surface_class for mesh in meshes])
        self.texture = np.concatenate([mesh.texture[mesh.faces] for mesh in meshes])
        edges = self.texture[:, 1:] - self.texture[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        self.texture_normal = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

    def at(self, seconds: np.ndarray, without: Collection[str] = ()) -> "StreetSnapshot":
        """The street at the times `seconds` (m,), without the moving objects of these names."""
        return StreetSnapshot(self, seconds, without)


class StreetSnapshot:
    """The street at m times. A ray sees it at the time of its moment."""

    def __init__(self, caster: RayCaster, seconds: np.ndarray, without: Collection[str]):
        self.caster = caster
        poses: dict[int, np.ndarray] = {}
        self._pieces = []
        for number, piece, scene in caster._moving:
            item = caster.objects[number]
            if item.name in without:
                continue
            if number not in poses:
                poses[number] = item.piece_poses(seconds)
            self._pieces.append((poses[number][:, piece], scene))

    def cast(self, rays: Rays) -> RayHits:
        """The first hit of each ray."""
        count = len(rays)
        hits = RayHits(
            np.full(count, np.inf), np.full(count, NO_HIT, np.int32), np.full(count, NO_HIT, np.int64),
            np.zeros((count, 3)), np.zeros((count, 2)),
        )  # fmt: skip
        static = self.caster._static
        if static is not None:
            _keep_nearer(hits, static, static.intersect(rays.starts(), rays.directions), None, None)
        for poses, piece in self._pieces:
            chosen, origins, directions = _in_frame_of(piece, poses, rays.origins, rays.directions, rays.moment)
            if len(chosen):
                _keep_nearer(hits, piece, piece.intersect(origins, directions), chosen, poses[rays.moment[chosen]])
        return hits

    def unoccluded(self, points: np.ndarray, direction: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Whether nothing lies beyond each of `points` (n, 3) along `direction` (3,), at the time of `moment` (n,):
        (n,) bool."""
        directions, free = np.broadcast_to(direction, points.shape), np.ones(len(points), dtype=bool)
        if self.caster._static is not None:
            free &= ~self.caster._static.occluded(points, directions)
        for poses, piece in self._pieces:
            chosen, origins, toward = _in_frame_of(piece, poses, points, directions, moment, own_origins=True)
            chosen_free = free[chosen]
            if chosen_free.any():
                kept = chosen[chosen_free]
                free[kept] = ~piece.occluded(origins[chosen_free], toward[chosen_free])
        return free


def _keep_nearer(
    hits: RayHits, piece: EmbreePiece, found: dict[str, np.ndarray], chosen: np.ndarray | None, poses: np.ndarray | None
) -> None:
    """Enters Embree's hits of the rays `chosen` (all if None) that are nearer than those known. `poses` (chosen, 4, 4)
    is the piece's frame to street."""
    known = hits.distance if chosen is None else hits.distance[chosen]
    nearer = np.flatnonzero((found["geomID"] >= 0) & (found["tfar"] < known))
    rows = nearer if chosen is None else chosen[nearer]
    geometry = found["geomID"][nearer]
    hits.distance[rows] = found["tfar"][nearer]
    hits.object[rows] = piece.owners[geometry]
    hits.face[rows] = found["primID"][nearer] + piece.first_faces[geometry]
    normals = found["Ng"][nearer]
    hits.normal[rows] = normals if poses is None else np.einsum("nij,nj->ni", poses[nearer, :3, :3], normals)
    hits.weights[rows, 0], hits.weights[rows, 1] = found["u"][nearer], found["v"][nearer]


def _in_frame_of(
    piece: EmbreePiece, poses: np.ndarray, origins: np.ndarray, directions: np.ndarray, moment: np.ndarray,
    own_origins: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """The indices (k,) of the rays that may hit a moving piece, with their origins and directions (k, 3) in its frame.
    `poses` (m, 4, 4): the piece to street. `origins` are those of moments (m, 3), or with `own_origins` of rays."""
    rotations, centers = np.ascontiguousarray(poses[:, :3, :3]), poses[:, :3, 3]
    return _local_rays(directions, moment, origins, own_origins, rotations, centers, piece.center, piece.radius**2)


@kernel
@no_type_check
def _local_rays(directions, moment, origins, own_origins, rotations, positions, center, squared_radius):
    """The indices of the rays that pass a sphere around `center` (3,) in a frame, and these rays in that frame. The
    frame's `rotations` (m, 3, 3) and `positions` (m, 3) depend on the ray's moment."""
    chosen = np.empty(len(directions), np.int64)
    starts = np.empty((len(directions), 3), np.float32)
    toward = np.empty((len(directions), 3), np.float32)
    count = 0
    start, ray = np.empty(3), np.empty(3)
    for i in range(len(directions)):
        m = moment[i]
        source = i if own_origins else m
        for c in range(3):
            start[c] = ray[c] = 0.0
            for r in range(3):
                start[c] += rotations[m, r, c] * (origins[source, r] - positions[m, r])
                ray[c] += rotations[m, r, c] * directions[i, r]
        x, y, z = center[0] - start[0], center[1] - start[1], center[2] - start[2]
        squared = x * x + y * y + z * z
        along = x * ray[0] + y * ray[1] + z * ray[2]
        if squared <= squared_radius or (along > 0.0 and squared - along * along <= squared_radius):
            chosen[count] = i
            for c in range(3):
                starts[count, c], toward[count, c] = start[c], ray[c]
            count += 1
    return chosen[:count], starts[:count], toward[:count]
