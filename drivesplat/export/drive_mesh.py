"""The static world of a trained drive as a coarse mesh, from depth that its recorded cameras show: depth images fused
by a truncated signed distance (Curless and Levoy 1996).

The volume consists of blocks of BLOCK³ voxels, which lie at the corners of a lattice with edges of `edge` metres.
Blocks exist about the surfaces that depth images show. A voxel has the weighted mean of its signed distances to the
planes through what its pixels show, in units of TRUNCATION edges: 1 far before a surface, 0 on it, negative behind.
Images that look through a block also count there, and so remove what only one image shows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from scipy.ndimage import binary_erosion
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.io.triangle_mesh import TriangleMesh
from drivesplat.model.height_field import HeightField
from drivesplat.scene.scene import Frame
from drivesplat.trajectories.camera_path import recorded_frames

EDGE = 0.3
"""Metres between voxels."""
MAX_DEPTH, MIN_ALPHA, MAX_CLEAR = 40.0, 0.7, 0.05
"""Metres up to which depth counts, the least opacity where it does, and the largest where there is nothing."""
MAX_SLOPE = 0.5
"""Depth that differs by more than this share from a pixel beside it is between two surfaces."""
WIDTH, MAX_IMAGES, MIN_STEP = 400, 160, 1.0
"""The largest width of depth images in pixels, their largest number, and the metres between those of one camera."""
ON_PATH = 10.0
"""Metres beside the path within which the mesh has the ground where no image shows it."""
BLOCK = 8
"""Voxels along the edge of a block."""
TILE = 8
"""Blocks along the edge of the cube whose mesh is made at once."""
TRUNCATION = 3.0
"""Edges of a voxel up to which distances count."""
MAX_BLOCKS = 16_000
"""Blocks of a volume; with more its edges grow by COARSER until there are not."""
COARSER = 1.25
BEHIND = 2.0
"""Metres behind what a pixel shows up to which it says that there is something."""
FULL_WEIGHT, MIN_COSINE = 10.0, 0.05
"""Metres up to which depth has full weight; beyond, its weight falls with the square of the distance. It is also
proportional to the cosine between ray and normal, or to the least one."""
OF_NOTHING = 0.3
"""The least weight of pixels before whose surface, if they show any, there is nothing."""
NUDGE = 1e-3
"""The least absolute distance: no vertex is on a voxel, so that each triangle is within a cell."""
MIN_TRIANGLES = 60
"""Smaller pieces of a mesh are left out."""


@dataclass(frozen=True, eq=False)
class DepthImage:
    """The `depth` of an image in metres along the camera's axis, 0 where it is not known, infinite where there is
    nothing; `K` in continuous pixels; the pose of an OpenCV camera."""

    depth: Float32[np.ndarray, "h w"]
    K: Float[np.ndarray, "3 3"]
    camera_to_world: Float[np.ndarray, "4 4"]

    @property
    def shows(self) -> Bool[np.ndarray, "h w"]:
        """The pixels that show a surface."""
        return (self.depth > 0.0) & np.isfinite(self.depth)

    @cached_property
    def points(self) -> Float32[np.ndarray, "h w 3"]:
        """What the pixels show, world metres; the camera's place where they show no surface."""
        rows, columns = np.indices(self.depth.shape)
        x, y = (columns + 0.5 - self.K[0, 2]) / self.K[0, 0], (rows + 0.5 - self.K[1, 2]) / self.K[1, 1]
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.camera_to_world[:3, :3].T
        return (self.camera_to_world[:3, 3] + np.where(self.shows, self.depth, 0.0)[..., None] * rays).astype(
            np.float32
        )

    @cached_property
    def normals(self) -> Float32[np.ndarray, "h w 3"]:
        """Unit normals of the surfaces there, towards the camera; the direction to the camera where the pixels around
        do not tell."""
        to_camera = self.camera_to_world[:3, 3] - self.points
        to_camera /= np.maximum(np.linalg.norm(to_camera, axis=-1, keepdims=True), 1e-9)
        down, right = (np.gradient(self.points, axis=axis) for axis in (0, 1))
        normals = np.cross(down, right)
        lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = normals / np.maximum(lengths, 1e-12)
        normals *= np.where((normals * to_camera).sum(axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
        known = binary_erosion(self.shows)[..., None] & (lengths > 1e-12)
        return np.where(known, normals, to_camera).astype(np.float32)

    @cached_property
    def weights(self) -> Float32[np.ndarray, "h w"]:
        """How much the pixels count."""
        rays = self.points - self.camera_to_world[:3, 3]
        cosine = np.abs((rays * self.normals).sum(axis=-1)) / np.maximum(np.linalg.norm(rays, axis=-1), 1e-9)
        near = np.minimum(1.0, FULL_WEIGHT / np.maximum(self.depth, 1e-9)) ** 2
        weights = np.where(self.shows, near * np.maximum(cosine, MIN_COSINE), OF_NOTHING)
        return weights.astype(np.float32)


def drive_mesh(drive: TrainedDrive, ground: HeightField) -> TriangleMesh:
    """The surfaces within MAX_DEPTH of the recorded cameras, without the objects that have Gaussians of their own, and
    the `ground` on which the vehicle drove."""
    path = drive.ego_path(np.linspace(0.0, drive.duration, 2 + int(drive.duration / 0.1)))[:, :2, 3]
    return fused_mesh(list(depth_images(drive)), EDGE, _near(ground, path))


def depth_images(drive: TrainedDrive) -> Iterator[DepthImage]:
    """The depth that the recorded cameras show, MIN_STEP apart, at most MAX_IMAGES in all."""
    per_camera = max(1, MAX_IMAGES // max(1, len(drive.cameras)))
    for name in drive.cameras:
        camera = drive.camera(name)
        camera = camera.resized(WIDTH) if camera.width > WIDTH else camera
        for frame in _thinned(recorded_frames(drive.scene, name), per_camera):
            world = drive.state(drive.scene.seconds(frame.timestamp), placements={})
            view = world.render(camera, camera_to_world=frame.camera_to_world, outputs=["depth", "alpha", "valid"])
            arrays = view.arrays()
            yield DepthImage(_known_depth(**arrays), camera.K, frame.camera_to_world)


def _known_depth(
    depth: Float32[np.ndarray, "h w"], alpha: Float32[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Depth as `DepthImage` has it, of what a drive renders."""
    opaque, clear = alpha >= MIN_ALPHA, alpha <= MAX_CLEAR
    known = np.where(opaque & (depth < MAX_DEPTH) & ~_between(depth), depth, 0.0)
    return np.where(valid, np.where(clear, np.inf, known), 0.0).astype(np.float32)


def _thinned(frames: list[Frame], most: int) -> list[Frame]:
    """The images that are MIN_STEP apart, evenly thinned to at most so many."""
    kept = frames[:1]
    for frame in frames[1:]:
        if np.linalg.norm(frame.camera_to_world[:3, 3] - kept[-1].camera_to_world[:3, 3]) >= MIN_STEP:
            kept.append(frame)
    chosen = np.unique(np.linspace(0, len(kept) - 1, min(most, len(kept))).astype(int))
    return [kept[i] for i in chosen]


def _between(depth: Float[np.ndarray, "h w"]) -> np.ndarray:
    """The pixels (h, w) at which depth steps, as at the edge of what stands before something else."""
    steps = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        near, far = (np.take(depth, np.arange(depth.shape[axis] - 1) + i, axis=axis) for i in (0, 1))
        step = np.abs(far - near) > MAX_SLOPE * np.minimum(near, far)
        pads = [[(0, 1) if a == axis else (0, 0) for a in (0, 1)], [(1, 0) if a == axis else (0, 0) for a in (0, 1)]]
        steps |= np.pad(step, pads[0]) | np.pad(step, pads[1])
    return steps


def _near(ground: HeightField, path: Float[np.ndarray, "p 2"]) -> HeightField:
    """The ground within ON_PATH of a path."""
    cells = np.stack(np.indices(tuple(ground.covered.shape)), axis=-1).reshape(-1, 2)
    middles = ground.lower.double().numpy() + ground.edge * (cells + 0.5)
    near = np.isfinite(cKDTree(path).query(middles, distance_upper_bound=ON_PATH)[0])
    return replace(ground, covered=ground.covered & torch.from_numpy(near).reshape(ground.covered.shape))


def fused_mesh(images: Sequence[DepthImage], edge: float, ground: HeightField | None = None) -> TriangleMesh:
    """The surfaces that depth images show, by voxels with edges of `edge` metres, or more where these are too many;
    where no image looks, also the `ground` where it is covered. Empty where there is neither."""
    keys = _blocks(images, edge, ground)
    while len(keys) > MAX_BLOCKS:
        edge *= COARSER
        keys = _blocks(images, edge, ground)
    if not len(keys):
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    volume = _Volume(keys, edge)
    for image in images:
        volume.add(image)
    if ground is not None:
        volume.fill(ground)
    return without_small_pieces(volume.mesh())


def _blocks(images: Sequence[DepthImage], edge: float, ground: HeightField | None) -> Int[np.ndarray, "b 3"]:
    """The blocks near surfaces, in order."""
    reach, side = TRUNCATION * edge, BLOCK * edge
    found = [np.zeros((0, 3), dtype=np.int64)]
    for image in images:
        points, away = image.points[image.shows], reach * image.normals[image.shows]
        near = [np.floor((points + step * away) / side).astype(np.int64) for step in (-1.0, 0.0, 1.0)]
        found.append(np.unique(np.concatenate(near), axis=0))
    if ground is not None:
        cells = ground.covered.nonzero().double().numpy()
        inside = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]])
        places = ground.lower.double().numpy() + ground.edge * (cells[:, None] + inside).reshape(-1, 2)
        heights = ground.at(torch.from_numpy(places).float()).double().numpy()
        levels = [np.column_stack([places, heights + step]) for step in (-reach, 0.0, reach)]
        found.append(np.floor(np.concatenate(levels) / side).astype(np.int64))
    return np.unique(np.concatenate(found), axis=0)


class _Volume:
    """The `values` (b, BLOCK, BLOCK, BLOCK) of voxels, and their `weights`, 0 where no image looks."""

    def __init__(self, keys: Int[np.ndarray, "b 3"], edge: float):
        self.keys, self.edge = keys, edge
        within = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        self._within = within * edge
        self.values = np.zeros((len(keys), BLOCK**3), dtype=np.float32)
        self.weights = np.zeros_like(self.values)

    def voxels(self, blocks: Int[np.ndarray, " c"]) -> Float[np.ndarray, "c v 3"]:
        """The places of the voxels of blocks, metres."""
        return self.keys[blocks, None] * (BLOCK * self.edge) + self._within

    def add(self, image: DepthImage) -> None:
        """Adds the distances along the rays of an image."""
        reach, half = TRUNCATION * self.edge, 0.5 * BLOCK * self.edge
        radius, (height, width) = np.sqrt(3.0) * half, image.depth.shape
        farthest = image.depth.max(initial=0.0) + BEHIND
        middle = _pixels(image, self.keys * (BLOCK * self.edge) + half)[2]
        seen = np.flatnonzero((middle > -radius) & (middle < farthest + radius))
        for part in np.array_split(seen, max(1, len(seen) // 1024)):
            places = self.voxels(part).reshape(-1, 3)
            columns, rows, depth = _pixels(image, places)
            inside = (depth > 0.05) & (depth < farthest)
            inside = np.flatnonzero(inside & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height))
            pixels = rows[inside].astype(np.int64), columns[inside].astype(np.int64)
            shown = image.depth[pixels]
            known = (shown > 0.0) & (depth[inside] < shown + BEHIND)
            inside, pixels, shown = inside[known], tuple(index[known] for index in pixels), shown[known]
            normals = image.normals[pixels]
            distance = ((places[inside] - image.points[pixels]) * normals).sum(axis=1) / reach
            distance = np.where(np.isfinite(shown), distance, 1.0)
            counts = distance > -1.0
            block, voxel = np.unravel_index(inside[counts], (len(part), BLOCK**3))
            value, weight = np.minimum(distance[counts], 1.0).astype(np.float32), image.weights[pixels][counts]
            weight = np.where(value < 1.0, weight, np.maximum(weight, np.float32(OF_NOTHING)))
            self.values[part[block], voxel] += weight * value
            self.weights[part[block], voxel] += weight

    def fill(self, ground: HeightField) -> None:
        """Gives voxels near the ground at which no image looks their height above it."""
        for part in np.array_split(np.arange(len(self.keys)), max(1, len(self.keys) // 1024)):
            places = self.voxels(part).reshape(-1, 3)
            at = torch.from_numpy(places[:, :2]).float()
            over = (places[:, 2] - ground.at(at).double().numpy()) / (TRUNCATION * self.edge)
            own = (self.weights[part].ravel() == 0.0) & (np.abs(over) < 1.0) & ground.covers(at).numpy()
            values, weights = self.values[part].ravel(), self.weights[part].ravel()
            values[own], weights[own] = over[own], 1.0
            self.values[part], self.weights[part] = values.reshape(-1, BLOCK**3), weights.reshape(-1, BLOCK**3)

    def mesh(self) -> TriangleMesh:
        """The surface where the distance is 0, between voxels at which images look."""
        tiles = np.floor_divide(self.keys, TILE)
        number = {tuple(key): i for i, key in enumerate(self.keys.tolist())}
        vertices, triangles, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
        for tile in np.unique(tiles, axis=0):
            found = self._tile_mesh(tile, number)
            if found is not None:
                vertices.append(found.vertices)
                triangles.append(found.triangles + count)
                count += len(found.vertices)
        return _welded(TriangleMesh(np.concatenate(vertices), np.concatenate(triangles)), 1e-3 * self.edge)

    def _tile_mesh(self, tile: Int[np.ndarray, "3"], number: dict[tuple[int, ...], int]) -> TriangleMesh | None:
        """The mesh of a cube of blocks, up to the first voxels of the next ones."""
        length = TILE * BLOCK + 1
        values = np.ones((length + BLOCK - 1,) * 3, dtype=np.float32)
        known = np.zeros_like(values, dtype=bool)
        for offset in np.ndindex((TILE + 1,) * 3):
            block = number.get(tuple((tile * TILE + offset).tolist()))
            if block is None:
                continue
            weights = self.weights[block].reshape((BLOCK,) * 3)
            at = tuple(slice(BLOCK * i, BLOCK * (i + 1)) for i in offset)
            known[at] = weights > 0.0
            values[at] = np.where(known[at], self.values[block].reshape((BLOCK,) * 3) / np.maximum(weights, 1e-9), 1.0)
        values, known = values[:length, :length, :length], known[:length, :length, :length]
        values = np.where(np.abs(values) < NUDGE, np.copysign(np.float32(NUDGE), values), values)
        whole = known[:-1, :-1, :-1].copy()
        for corner in np.ndindex(2, 2, 2):
            whole &= known[tuple(slice(i, length - 1 + i) for i in corner)]
        if not whole.any() or values[known].min() >= 0.0:
            return None
        vertices, triangles, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
        cells = np.floor(vertices[triangles].mean(axis=1)).astype(np.int64)
        mesh = TriangleMesh(vertices.astype(np.float64), triangles.astype(np.int64))
        mesh = mesh.with_triangles(whole[tuple(cells.T)])
        return replace(mesh, vertices=(mesh.vertices + tile * (TILE * BLOCK)) * self.edge)


def _pixels(image: DepthImage, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The columns (n,) and rows (n,) at which an image shows points, continuous, and their depths (n,) in metres."""
    x, y, z = ((points - image.camera_to_world[:3, 3]) @ image.camera_to_world[:3, :3]).T
    before = np.maximum(z, 1e-6)
    return image.K[0, 0] * x / before + image.K[0, 2], image.K[1, 1] * y / before + image.K[1, 2], z


def _welded(mesh: TriangleMesh, tolerance: float) -> TriangleMesh:
    """A mesh whose equal vertices are one, without the triangles that this leaves no area."""
    _, first, numbers = np.unique(
        np.rint(mesh.vertices / tolerance).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    triangles = numbers.reshape(-1)[mesh.triangles]
    a, b, c = triangles.T
    return TriangleMesh(mesh.vertices[first], triangles[(a != b) & (b != c) & (c != a)])


def without_small_pieces(mesh: TriangleMesh, least: int = MIN_TRIANGLES) -> TriangleMesh:
    """The connected pieces of a mesh with at least so many triangles."""
    first, second = mesh.triangles[:, [0, 1]].ravel(), mesh.triangles[:, [1, 2]].ravel()
    size = (len(mesh.vertices),) * 2
    _, piece = connected_components(coo_matrix((np.ones(len(first), dtype=bool), (first, second)), size), False)
    of_triangle = piece[mesh.triangles[:, 0]]
    return mesh.with_triangles(np.bincount(of_triangle, minlength=len(piece) or 1)[of_triangle] >= least)
