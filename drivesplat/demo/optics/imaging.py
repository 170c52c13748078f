"""Camera images of the street: radiance, depth, and the object and class that each pixel shows."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drivesplat.demo.optics.lighting import Light, shade
from drivesplat.demo.optics.raycast import NO_HIT, RayHits, Rays, StreetSnapshot
from drivesplat.demo.shapes.mesh import SurfaceClass

MAX_RAYS = 400_000
"""Rays cast at once, which bounds memory."""
SHADOW_OFFSET = 2e-3
"""Distance (metres) from a surface to the start of its shadow ray; larger far away, where float32 is coarse."""
EXPOSURE = 0.62
R2_STEPS = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 sequence (Roberts 2018), which spreads any number of points evenly over a square."""


@dataclass(frozen=True)
class DemoCamera:
    """A pinhole camera. `intrinsics` (3, 3), OpenCV's convention; `seconds` (m,) and `camera_to_street` (m, 4, 4) of
    its m rows, or of all at once (m = 1) with a global shutter; `gains` of the red, green and blue channels."""

    intrinsics: np.ndarray
    seconds: np.ndarray
    camera_to_street: np.ndarray
    width: int
    height: int
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def rays(self, rows: slice, samples: int) -> Rays:
        """The rays (rows * width * samples). The first of `samples` passes through the pixel centre."""
        offsets = (0.5 + R2_STEPS * np.arange(samples)[:, None]) % 1.0 - 0.5
        y, x = np.mgrid[rows, : self.width].astype(np.float64)
        pixels = np.stack([x, y], axis=-1)[:, :, None, :] + offsets
        pixels = (pixels - self.intrinsics[:2, 2]) / self.intrinsics.diagonal()[:2]
        rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
        first = rows.start if len(self.seconds) > 1 else 0
        poses = self.camera_to_street[first : first + (len(y) if len(self.seconds) > 1 else 1)]
        rays = (rays.reshape(len(poses), -1, 3) @ np.swapaxes(poses[:, :3, :3], 1, 2)).reshape(-1, 3)
        moment = np.repeat(np.arange(first, first + len(poses), dtype=np.int32), len(rays) // len(poses))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return Rays(self.seconds, self.camera_to_street[:, :3, 3], rays, moment)

    @property
    def pose(self) -> np.ndarray:
        """Camera to street (4, 4) at the image's timestamp: the middle of its readout."""
        return self.camera_to_street[len(self.camera_to_street) // 2]

    def blocks(self, samples: int) -> Iterator[tuple[slice, Rays]]:
        """Blocks of image rows and their rays."""
        step = max(1, MAX_RAYS // (self.width * samples))
        for y in range(0, self.height, step):
            rows = slice(y, min(y + step, self.height))
            yield rows, self.rays(rows, samples)


@dataclass(frozen=True)
class Picture:
    """An image of the street. `radiance` (h, w, 3) float64 times the camera's gains. At pixel centres: `depth` (h, w)
    along the optical axis in metres, infinite for the sky; `objects` (h, w), the index of the visible object, -1 for
    the sky; `classes` (h, w) uint8, values of `SurfaceClass`."""

    radiance: np.ndarray
    depth: np.ndarray
    objects: np.ndarray
    classes: np.ndarray


def render(snapshot: StreetSnapshot, light: Light, camera: DemoCamera, samples: int) -> Picture:
    """The image, each pixel averaged over `samples` rays."""
    size = camera.height, camera.width
    picture = Picture(np.empty((*size, 3)), np.empty(size), np.empty(size, np.int32), np.empty(size, np.uint8))
    for rows, rays in camera.blocks(samples):
        hits = snapshot.cast(rays)
        radiance = _radiance(snapshot, light, camera, rays, hits, samples)
        picture.radiance[rows] = radiance.reshape(-1, camera.width, samples, 3).mean(axis=2)
        _enter_geometry(picture, snapshot, camera, rows, rays, hits, samples)
    return Picture(picture.radiance * camera.gains, picture.depth, picture.objects, picture.classes)


def geometry(snapshot: StreetSnapshot, camera: DemoCamera) -> Picture:
    """The image without its radiance, which is NaN."""
    size = camera.height, camera.width
    picture = Picture(
        np.full((*size, 3), np.nan), np.empty(size), np.empty(size, np.int32), np.empty(size, np.uint8)
    )  # fmt: skip
    for rows, rays in camera.blocks(1):
        _enter_geometry(picture, snapshot, camera, rows, rays, snapshot.cast(rays), 1)
    return picture


def _enter_geometry(
    picture: Picture, snapshot: StreetSnapshot, camera: DemoCamera, rows: slice, rays: Rays, hits: RayHits, samples: int
) -> None:
    """Enters what the ray through each pixel centre hits, the first of its `samples`."""
    axes = camera.camera_to_street[rays.moment[::samples], :3, 2]
    cosine = np.einsum("ni,ni->n", rays.directions[::samples], axes)
    face = hits.face[::samples]
    classes = np.where(face >= 0, snapshot.caster.surface_class[face], int(SurfaceClass.SKY))
    picture.depth[rows] = (hits.distance[::samples] * cosine).reshape(-1, camera.width)
    picture.objects[rows] = hits.object[::samples].reshape(-1, camera.width)
    picture.classes[rows] = classes.reshape(-1, camera.width)


def _radiance(
    snapshot: StreetSnapshot, light: Light, camera: DemoCamera, rays: Rays, hits: RayHits, samples: int
) -> np.ndarray:
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
        caster.texture, caster.texture_normal, caster.material, caster.color,
        1.0 / (camera.intrinsics[0, 0] * np.sqrt(samples)), light, radiance,
    )  # fmt: skip
    return radiance


def to_bytes(radiance: np.ndarray, noise: float = 0.0, random: np.random.Generator | None = None) -> np.ndarray:
    """Gamma-encoded bytes (h, w, 3), with sensor noise of standard deviation `noise` (fraction of full scale) if
    `random` is given."""
    image = np.clip(EXPOSURE * radiance, 0.0, 1.0) ** (1 / 2.2)
    if random is not None and noise:
        image = image + random.normal(0.0, noise, image.shape)
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
