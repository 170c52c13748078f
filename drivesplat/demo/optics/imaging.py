"""Camera images of the street: radiance, depth, and the object that each pixel shows."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drivesplat.demo.lighting import Light, shade
from drivesplat.demo.raycast import StreetSnapshot

MAX_RAYS = 400_000
"""Rays cast at once, which bounds memory."""
SHADOW_OFFSET = 2e-3
"""Distance (metres) from a surface to the start of its shadow ray; larger far away, where float32 is coarse."""
EXPOSURE = 0.62
R2_STEPS = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 sequence (Roberts 2018), which spreads any number of points evenly over a square."""


@dataclass(frozen=True)
class DemoCamera:
    """A pinhole camera: `intrinsics` (3, 3) and `camera_to_street` (4, 4) in OpenCV's convention; `gains` of the red,
    green and blue channels."""

    intrinsics: np.ndarray
    camera_to_street: np.ndarray
    width: int
    height: int
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def rays(self, rows: slice, samples: int) -> np.ndarray:
        """Unit directions (rows * width * samples, 3) in the street frame. The first of `samples` passes through the
        pixel centre."""
        offsets = (0.5 + R2_STEPS * np.arange(samples)[:, None]) % 1.0 - 0.5
        y, x = np.mgrid[rows, : self.width].astype(np.float64)
        pixels = np.stack([x, y], axis=-1)[:, :, None, :] + offsets
        pixels = (pixels - self.intrinsics[:2, 2]) / self.intrinsics.diagonal()[:2]
        rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1).reshape(-1, 3)
        rays = rays @ self.camera_to_street[:3, :3].T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    @property
    def center(self) -> np.ndarray:
        """Optical centre (3,) in the street frame."""
        return self.camera_to_street[:3, 3]

    def blocks(self, samples: int) -> Iterator[tuple[slice, np.ndarray]]:
        """Blocks of image rows and the directions of their rays."""
        step = max(1, MAX_RAYS // (self.width * samples))
        for y in range(0, self.height, step):
            rows = slice(y, min(y + step, self.height))
            yield rows, self.rays(rows, samples)


def render(snapshot: StreetSnapshot, light: Light, camera: DemoCamera, samples: int) -> np.ndarray:
    """Radiance (h, w, 3) float64 times the camera's gains, averaged over `samples` rays per pixel."""
    image = np.empty((camera.height, camera.width, 3))
    for rows, directions in camera.blocks(samples):
        radiance = _radiance(snapshot, light, camera, directions, samples)
        image[rows] = radiance.reshape(-1, camera.width, samples, 3).mean(axis=2)
    return image * camera.gains


def _radiance(
    snapshot: StreetSnapshot, light: Light, camera: DemoCamera, directions: np.ndarray, samples: int
) -> np.ndarray:
    hits = snapshot.cast(camera.center, directions)
    lit = np.zeros(len(directions), dtype=bool)
    if light.sun.any():
        hit = np.flatnonzero(hits.object >= 0)
        distance = hits.distance[hit]
        start = (distance - SHADOW_OFFSET * (1.0 + 0.02 * distance))[:, None]
        lit[hit] = snapshot.unoccluded(camera.center + start * directions[hit], light.sun_direction)
    radiance = np.empty_like(directions)
    shade(
        directions, camera.center, hits.distance, hits.object, hits.face, hits.normal, lit, snapshot.to_object,
        snapshot.material, snapshot.color, 1.0 / (camera.intrinsics[0, 0] * np.sqrt(samples)), light, radiance,
    )  # fmt: skip
    return radiance


def to_bytes(radiance: np.ndarray, noise: float = 0.0, random: np.random.Generator | None = None) -> np.ndarray:
    """Gamma-encoded bytes (h, w, 3), with sensor noise of standard deviation `noise` (fraction of full scale) if
    `random` is given."""
    image = np.clip(EXPOSURE * radiance, 0.0, 1.0) ** (1 / 2.2)
    if random is not None and noise:
        image = image + random.normal(0.0, noise, image.shape)
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def depth_and_objects(snapshot: StreetSnapshot, camera: DemoCamera) -> tuple[np.ndarray, np.ndarray]:
    """At pixel centres: depth along the optical axis (h, w) in metres, infinite for the sky, and the index of the
    visible object (h, w), -1 for the sky."""
    depth, objects = np.empty((camera.height, camera.width)), np.empty((camera.height, camera.width), dtype=np.int64)
    for rows, directions in camera.blocks(1):
        hits = snapshot.cast(camera.center, directions)
        depth[rows] = (hits.distance * (directions @ camera.camera_to_street[:3, 2])).reshape(-1, camera.width)
        objects[rows] = hits.object.reshape(-1, camera.width)
    return depth, objects
