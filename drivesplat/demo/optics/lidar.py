"""A spinning LiDAR with 32 beams: the Velodyne HDL-32E of nuScenes."""

from typing import no_type_check

import numpy as np

from drivesplat.demo.lighting import facing_normal, rotated
from drivesplat.demo.materials import compiled, surface
from drivesplat.demo.raycast import StreetSnapshot
from drivesplat.scene.rigid import apply, inverse

ELEVATIONS = np.radians(np.linspace(-30.67, 10.67, 32))
AZIMUTH_STEPS = 1085
"""Firings of a beam in one revolution, at 20 Hz."""
MAX_RANGE, MIN_RANGE = 100.0, 0.9
FOOTPRINT = 0.05
"""Width of a beam on a surface (metres), which filters textures."""
RANGE_NOISE = 0.02
"""Standard deviation of a range (metres)."""


def scan(
    snapshot: StreetSnapshot, sensor_to_street: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The returns (n, 5) float32 of one revolution, and the index of the object (n,) that each comes from.

    Columns: x, y, z in metres in the sensor's frame, intensity 0 to 255, ring. All beams fire at the snapshot's time,
    as in motion-compensated sweeps. Returns that are too weak for their distance are dropped.
    """
    directions = _beams() @ sensor_to_street[:3, :3].T
    origin = np.ascontiguousarray(sensor_to_street[:3, 3])
    hits = snapshot.cast(origin, directions)
    near = np.flatnonzero((hits.object >= 0) & (hits.distance > MIN_RANGE) & (hits.distance < MAX_RANGE))
    distance, objects, rays = hits.distance[near].astype(np.float64), hits.object[near], directions[near]
    reflected = np.empty(len(near))
    _reflect(
        rays, origin, distance, objects, hits.face[near], hits.normal[near], snapshot.to_object, snapshot.material,
        snapshot.color, reflected,
    )  # fmt: skip
    kept = reflected > 0.05 * (distance / MAX_RANGE) ** 2 * random.uniform(0.5, 1.5, len(near))
    distance = distance + random.normal(0.0, RANGE_NOISE, len(near))
    points = apply(inverse(sensor_to_street), origin + distance[:, None] * rays)
    ring = np.repeat(np.arange(len(ELEVATIONS)), AZIMUTH_STEPS)[near]
    table = np.column_stack([points, np.clip(255.0 * reflected, 0.0, 255.0).round(), ring])
    return table[kept].astype(np.float32), objects[kept]


def _beams() -> np.ndarray:
    """Unit directions (32 * AZIMUTH_STEPS, 3) in the sensor's frame, by ring from the lowest."""
    azimuth = np.linspace(-np.pi, np.pi, AZIMUTH_STEPS, endpoint=False)
    elevation, azimuth = np.meshgrid(ELEVATIONS, azimuth, indexing="ij")
    beams = [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)]
    return np.stack(beams, axis=-1).reshape(-1, 3)


@compiled
@no_type_check
def _reflect(directions, origin, distance, objects, face, normal, to_object, material, color, out):
    """Fills `out` (n,) with the reflected fraction of light: reflectance times the cosine to the beam."""
    for i in range(len(directions)):
        d, m = directions[i], to_object[objects[i]]
        x, y, z = rotated(
            m, origin[0] + distance[i] * d[0], origin[1] + distance[i] * d[1], origin[2] + distance[i] * d[2]
        )
        nx, ny, nz, facing = facing_normal(normal[i], d)
        base = color[face[i]]
        r, g, b, mirror, _ = surface(
            material[face[i]], base[0], base[1], base[2], x + m[0, 3], y + m[1, 3], z + m[2, 3],
            *rotated(m, nx, ny, nz), FOOTPRINT,
        )  # fmt: skip
        out[i] = facing * ((r + g + b) / 3.0 + 0.1 * mirror)
