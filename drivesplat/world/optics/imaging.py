"""Camera images of the street: radiance, depth, and the object and class that each pixel shows."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from drivesplat.world.optics.lighting import Light, find_paint, shade
from drivesplat.world.optics.raycast import NO_HIT, RayHits, StreetRays, StreetSnapshot
from drivesplat.world.shapes.mesh import GAMMA, SurfaceClass

MAX_RAYS = 400_000
"""Rays cast at once, which bounds memory."""
SHADOW_OFFSET = 2e-3
"""Distance (metres) from a surface to the start of its shadow ray; larger far away, where float32 is coarse."""
DEPTH_STEP = 0.05
"""Relative change of depth between pixels from which a surface counts as ending."""
FILTER = 0.7
"""Width of the filter of textures in pixels."""
EXPOSURE = 0.62
R2_STEPS = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 sequence (Roberts 2018), which spreads any number of points evenly over a square."""


@dataclass(frozen=True)
class WorldCamera:
    """A pinhole camera. `intrinsics` (3, 3), OpenCV's convention; `seconds` (m,) and `camera_to_street` (m, 4, 4) of
    its m rows, or of all at once (m = 1) with a global shutter; `gains` of the red, green and blue channels."""

    intrinsics: np.ndarray
    seconds: np.ndarray
    camera_to_street: np.ndarray
    width: int
    height: int
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def rays(self, x: np.ndarray, y: np.ndarray, row: np.ndarray) -> StreetRays:
        """The rays through points x, y (n,) in pixels, which belong to rows `row` (n,)."""
        in_camera = np.empty((len(x), 3))
        in_camera[:, 0] = (x - self.intrinsics[0, 2]) / self.intrinsics[0, 0]
        in_camera[:, 1] = (y - self.intrinsics[1, 2]) / self.intrinsics[1, 1]
        in_camera[:, 2] = 1.0
        in_camera /= np.linalg.norm(in_camera, axis=1, keepdims=True)
        poses = self.camera_to_street
        if len(self.seconds) == 1:
            moment = np.zeros(len(x), np.int32)
            # not by matmul, whose threads cost more than they bring where each process renders an image
            directions = np.einsum("ij,nj->ni", poses[0, :3, :3], in_camera)
        else:
            moment = row.astype(np.int32)
            directions = np.einsum("nij,nj->ni", poses[moment, :3, :3], in_camera)
        return StreetRays(self.seconds, poses[:, :3, 3], directions, moment)

    @property
    def pose(self) -> np.ndarray:
        """Camera to street (4, 4) at the image's timestamp: the middle of its readout."""
        return self.camera_to_street[len(self.camera_to_street) // 2]


@dataclass(frozen=True)
class StreetImage:
    """An image of the street. `radiance` (h, w, 3) float64 times the camera's gains. At pixel centres: `depth` (h, w)
    along the optical axis in metres, infinite for the sky; `objects` (h, w), the index of the visible object, -1 for
    the sky; `classes` (h, w) uint8, values of `SurfaceClass`; `markings` (h, w) bool, whether there is paint on the
    road."""

    radiance: np.ndarray
    depth: np.ndarray
    objects: np.ndarray
    classes: np.ndarray
    markings: np.ndarray


def render(snapshot: StreetSnapshot, light: Light, camera: WorldCamera, samples: int) -> StreetImage:
    """The image. Each pixel has a ray through its centre; where its surface ends or its light changes, it is averaged
    over `samples` rays."""
    picture, radiance, edges = _through_centers(snapshot, light, camera)
    rows, columns = np.nonzero(edges)
    # offsets in pixels from a pixel's centre, which is the first; the others spread evenly over it
    spread = (0.5 + R2_STEPS * np.arange(samples)[:, None]) % 1.0 - 0.5
    for block in _blocks(len(rows) if samples > 1 else 0, samples - 1):
        y, x = (np.repeat(at[block], samples - 1) for at in (rows, columns))
        offsets = np.tile(spread[1:], (len(rows[block]), 1))
        rays = camera.rays(x + offsets[:, 0], y + offsets[:, 1], y)
        found, _ = _radiance(snapshot, light, camera, rays, snapshot.cast(rays))
        total = found.reshape(-1, samples - 1, 3).sum(axis=1) + radiance[rows[block], columns[block]]
        radiance[rows[block], columns[block]] = total / samples
    return replace(picture, radiance=radiance * camera.gains)


def geometry(snapshot: StreetSnapshot, camera: WorldCamera) -> StreetImage:
    """The image without its radiance, which is empty."""
    return _through_centers(snapshot, None, camera)[0]


def _through_centers(
    snapshot: StreetSnapshot, light: Light | None, camera: WorldCamera
) -> tuple[StreetImage, np.ndarray, np.ndarray]:
    """The geometry at pixel centres, the radiance there (h, w, 3) unless there is no `light`, and the pixels (h, w)
    bool in which a surface ends or its light changes: they differ from one beside, above or below."""
    count, caster = camera.width * camera.height, snapshot.caster
    depth, objects, face = np.empty(count), np.empty(count, np.int32), np.empty(count, np.int64)
    markings = np.zeros(count, dtype=bool)
    radiance, lit = np.empty((count if light else 0, 3)), np.zeros(count, dtype=bool)
    for block in _blocks(count, 1):
        y, x = np.divmod(np.arange(count)[block], camera.width)
        rays = camera.rays(x.astype(np.float64), y.astype(np.float64), y)
        hits = snapshot.cast(rays)
        axes = camera.camera_to_street[rays.moment, :3, 2]
        depth[block] = hits.distance * np.einsum("ni,ni->n", rays.directions, axes)
        objects[block], face[block] = hits.object, hits.face
        road = np.flatnonzero((hits.face >= 0) & (caster.surface_class[hits.face] == SurfaceClass.ROAD))
        found = np.empty(len(road), dtype=bool)
        find_paint(hits.face[road], hits.weights[road], caster.texture, found)
        markings[block][road] = found
        if light:
            radiance[block], lit[block] = _radiance(snapshot, light, camera, rays, hits)
    size = camera.height, camera.width
    classes = np.where(face >= 0, caster.surface_class[face], int(SurfaceClass.SKY)).astype(np.uint8)
    planes = (values.reshape(size) for values in (depth, objects, classes, markings))
    picture = StreetImage(np.empty((0, 0, 3)), *planes)
    surfaces = np.where(face >= 0, caster.surface[face], NO_HIT).reshape(size)
    edges, lit, inverse_depth = np.zeros(size, dtype=bool), lit.reshape(size), 1.0 / picture.depth
    for axis in (0, 1) if light else ():
        first, second = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        near = np.maximum(inverse_depth[first], inverse_depth[second])
        differs = np.abs(inverse_depth[first] - inverse_depth[second]) > DEPTH_STEP * near
        differs |= (surfaces[first] != surfaces[second]) | (lit[first] != lit[second])
        edges[first] |= differs
        edges[second] |= differs
    return picture, radiance.reshape(*size, 3) if light else radiance, edges


def _blocks(count: int, rays_each: int) -> Iterator[slice]:
    """Slices of `count` items with at most MAX_RAYS rays each."""
    step = max(1, MAX_RAYS // max(1, rays_each))
    return (slice(start, min(start + step, count)) for start in range(0, count, step))


def _radiance(
    snapshot: StreetSnapshot, light: Light, camera: WorldCamera, rays: StreetRays, hits: RayHits
) -> tuple[np.ndarray, np.ndarray]:
    """The radiance (n, 3) that arrives along rays, and whether the sun is visible from what they hit (n,) bool."""
    lit = np.zeros(len(rays), dtype=bool)
    if light.sun.any():
        hit = np.flatnonzero(hits.object != NO_HIT)
        distance = hits.distance[hit]
        start = (distance - SHADOW_OFFSET * (1.0 + 0.02 * distance))[:, None]
        points = rays.origins[rays.moment[hit]] + start * rays.directions[hit]
        lit[hit] = snapshot.unoccluded(points, light.sun_direction, rays.moment[hit])
    caster, radiance = snapshot.caster, np.empty_like(rays.directions)
    shade(
        rays.directions, rays.origins, rays.moment, hits.distance, hits.face, hits.normal, hits.weights, lit,
        caster.texture, caster.texture_normal, caster.material, caster.color, FILTER / camera.intrinsics[0, 0], light,
        radiance,
    )  # fmt: skip
    return radiance, lit


def to_bytes(radiance: np.ndarray, noise: float = 0.0, random: np.random.Generator | None = None) -> np.ndarray:
    """Gamma-encoded bytes (h, w, 3), with sensor noise of standard deviation `noise` (fraction of full scale) if
    `random` is given."""
    image = np.clip(EXPOSURE * radiance, 0.0, 1.0) ** (1 / GAMMA)
    if random is not None and noise:
        image = image + random.normal(0.0, noise, image.shape)
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
