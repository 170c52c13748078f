"""A spinning LiDAR of 32 beams, as nuScenes has on the roof (Velodyne HDL-32E)."""

from typing import no_type_check

import numpy as np

from drivesplat.demo.lighting import facing_normal, turned
from drivesplat.demo.materials import compiled, surface
from drivesplat.demo.raycast import Stage
from drivesplat.scene.rigid import apply, inverse

ELEVATIONS = np.radians(np.linspace(-30.67, 10.67, 32))
COLUMNS = 1085
"""Firings a revolution at 20 Hz."""
MAX_RANGE, MIN_RANGE = 100.0, 0.9
FOOTPRINT = 0.05
"""Width of a beam on a surface (metres), for textures."""
RANGE_NOISE = 0.02
"""Standard deviation of a range (metres)."""


def revolution(
    stage: Stage, sensor_to_street: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The returns (n, 5) float32 of one revolution and the number of the thing (n,) each comes from.

    x, y, z in metres in the sensor's frame, intensity 0-255, ring. All beams fire at the stage's moment, as in
    nuScenes' motion-compensated sweeps. A return is lost where the surface sends too little back for its distance.
    """
    directions = _beams() @ sensor_to_street[:3, :3].T
    origin = np.ascontiguousarray(sensor_to_street[:3, 3])
    hits = stage.meet(origin, directions)
    near = np.flatnonzero((hits.thing >= 0) & (hits.distance > MIN_RANGE) & (hits.distance < MAX_RANGE))
    distance, thing, rays = hits.distance[near].astype(np.float64), hits.thing[near], directions[near]
    returned = np.empty(len(near))
    _returned(
        rays, origin, distance, thing, hits.face[near], hits.normal[near], stage.to_body, stage.material, stage.color,
        returned,
    )  # fmt: skip
    kept = returned > 0.05 * (distance / MAX_RANGE) ** 2 * random.uniform(0.5, 1.5, len(near))
    distance = distance + random.normal(0.0, RANGE_NOISE, len(near))
    points = apply(inverse(sensor_to_street), origin + distance[:, None] * rays)
    ring = np.repeat(np.arange(len(ELEVATIONS)), COLUMNS)[near]
    table = np.column_stack([points, np.clip(255.0 * returned, 0.0, 255.0).round(), ring])
    return table[kept].astype(np.float32), thing[kept]


def _beams() -> np.ndarray:
    """Unit directions (32 * COLUMNS, 3) in the sensor's frame, ring by ring from the lowest."""
    azimuth = np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False)
    elevation, azimuth = np.meshgrid(ELEVATIONS, azimuth, indexing="ij")
    beams = [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)]
    return np.stack(beams, axis=-1).reshape(-1, 3)


@compiled
@no_type_check
def _returned(directions, origin, distance, thing, face, normal, to_body, material, color, out):
    """Fills `out` (n,) with the share of light that surfaces send back: reflectance times the cosine to the beam."""
    for i in range(len(directions)):
        d, m = directions[i], to_body[thing[i]]
        x, y, z = turned(
            m, origin[0] + distance[i] * d[0], origin[1] + distance[i] * d[1], origin[2] + distance[i] * d[2]
        )
        nx, ny, nz, facing = facing_normal(normal[i], d)
        base = color[face[i]]
        r, g, b, mirror, _ = surface(
            material[face[i]], base[0], base[1], base[2], x + m[0, 3], y + m[1, 3], z + m[2, 3],
            *turned(m, nx, ny, nz), FOOTPRINT,
        )  # fmt: skip
        out[i] = facing * ((r + g + b) / 3.0 + 0.1 * mirror)
