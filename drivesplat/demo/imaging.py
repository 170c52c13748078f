"""What a camera sees of the street: colours, depth and which thing is where."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drivesplat.demo.lighting import Light, shade
from drivesplat.demo.raycast import Stage

CHUNK = 400_000
"""Rays at once: bounds memory."""
OFFSET = 2e-3
"""How far (metres) before a surface a ray from it to the sun begins; more at a distance, where floats are coarse."""
EXPOSURE = 0.62
SPREAD = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 sequence (Roberts 2018), which spreads any number of points evenly over a square."""


@dataclass(frozen=True)
class Camera:
    """`intrinsics` (3, 3), OpenCV's convention; `camera_to_street` (4, 4), OpenCV's axes; `gains`: how much of the red,
    green and blue light it takes in."""

    intrinsics: np.ndarray
    camera_to_street: np.ndarray
    width: int
    height: int
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def rays(self, rows: slice, samples: int) -> np.ndarray:
        """Unit directions (rows * width * samples, 3) in street coordinates, `samples` a pixel; one is its centre."""
        spread = (0.5 + SPREAD * np.arange(samples)[:, None]) % 1.0 - 0.5
        y, x = np.mgrid[rows, : self.width].astype(np.float64)
        pixels = np.stack([x, y], axis=-1)[:, :, None, :] + spread
        pixels = (pixels - self.intrinsics[:2, 2]) / self.intrinsics.diagonal()[:2]
        rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1).reshape(-1, 3)
        rays = rays @ self.camera_to_street[:3, :3].T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    @property
    def center(self) -> np.ndarray:
        """Its place (3,)."""
        return self.camera_to_street[:3, 3]

    def chunks(self, samples: int) -> Iterator[slice]:
        """Rows of the image that are cast together."""
        step = max(1, CHUNK // (self.width * samples))
        return (slice(y, min(y + step, self.height)) for y in range(0, self.height, step))


def photograph(stage: Stage, light: Light, camera: Camera, samples: int) -> np.ndarray:
    """Radiance (h, w, 3) float64 as the camera takes it in, the mean of `samples` rays a pixel."""
    image = np.empty((camera.height, camera.width, 3))
    for rows in camera.chunks(samples):
        directions = camera.rays(rows, samples)
        radiance = _radiance(stage, light, camera, directions, samples)
        image[rows] = radiance.reshape(-1, camera.width, samples, 3).mean(axis=2)
    return image * camera.gains


def _radiance(stage: Stage, light: Light, camera: Camera, directions: np.ndarray, samples: int) -> np.ndarray:
    hits = stage.meet(camera.center, directions)
    lit = np.zeros(len(directions), dtype=bool)
    if light.sun.any():
        met = np.flatnonzero(hits.thing >= 0)
        before = (hits.distance[met] - OFFSET * (1.0 + 0.02 * hits.distance[met]))[:, None]
        lit[met] = stage.reached(camera.center + before * directions[met], light.sun_direction)
    out = np.empty_like(directions)
    shade(
        directions, camera.center, hits.distance, hits.thing, hits.face, hits.normal, lit, stage.to_body,
        stage.material, stage.color, 1.0 / (camera.intrinsics[0, 0] * np.sqrt(samples)), light, out,
    )  # fmt: skip
    return out


def developed(radiance: np.ndarray, noise: float = 0.0, random: np.random.Generator | None = None) -> np.ndarray:
    """Bytes (h, w, 3) of radiance, with sensor noise of `noise` (fraction of full scale) where given."""
    image = np.clip(EXPOSURE * radiance, 0.0, 1.0) ** (1 / 2.2)
    if random is not None and noise:
        image = image + random.normal(0.0, noise, image.shape)
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def central_hits(stage: Stage, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Through every pixel's centre: depth along the camera's axis (h, w) in metres, infinite in the sky, and the
    number of the thing met (h, w), -1 in the sky."""
    depth, things = np.empty((camera.height, camera.width)), np.empty((camera.height, camera.width), dtype=np.int64)
    axis = camera.camera_to_street[:3, 2]
    for rows in camera.chunks(1):
        directions = camera.rays(rows, 1)
        hits = stage.meet(camera.center, directions)
        depth[rows] = (np.where(hits.thing >= 0, hits.distance, np.inf) * (directions @ axis)).reshape(-1, camera.width)
        things[rows] = hits.thing.reshape(-1, camera.width)
    return depth, things
