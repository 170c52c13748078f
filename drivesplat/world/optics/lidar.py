"""A spinning LiDAR: the time of each ray, reflectivity, dropped rays, mixed returns at edges."""

from dataclasses import dataclass
from functools import cached_property
from typing import no_type_check

import numpy as np

from drivesplat.settings.world import WorldLidarSettings
from drivesplat.world.optics.lighting import facing_normal, texture_point
from drivesplat.world.optics.materials import GLASS, LEAVES, METAL, PAINT, ROAD_, SIGN, surface
from drivesplat.world.optics.patterns import compiled
from drivesplat.world.optics.raycast import NO_HIT, StreetRays, StreetSnapshot

ELEVATIONS = {32: np.radians(np.linspace(-30.67, 10.67, 32)), 64: np.radians(np.linspace(-24.8, 2.0, 64))}
"""Of the Velodyne HDL-32E, which nuScenes uses, and of the HDL-64E (KITTI's); lowest first."""
STEPS = {20: 1085, 10: 2083}
"""Firings of a beam in one revolution, by revolutions a second."""
MAX_RANGE, MIN_RANGE = 100.0, 0.9
FOOTPRINT = 0.05
"""Width of a beam on a surface (metres), which filters textures."""
RANGE_NOISE = 0.02
"""Standard deviation of a range (metres)."""
FORWARD = 0.29
"""Fraction of a revolution after which the beams point forward, so that cameras fire as they pass (nuScenes)."""
EDGE_GAP = 0.3
"""Metres of range between surfaces that give separate echoes."""


@dataclass(frozen=True)
class ScanPattern:
    """The rays of a revolution: `elevations` (beams,) and `azimuths` (steps,) in radians; `offsets` (steps,) seconds
    relative to the sweep's timestamp, at which its revolution ends."""

    elevations: np.ndarray
    azimuths: np.ndarray
    offsets: np.ndarray

    @cached_property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """The distinct offsets (m,), and for each step the index (steps,) of its own."""
        offsets, index = np.unique(self.offsets, return_inverse=True)
        return offsets, index.ravel().astype(np.int32)

    @property
    def shape(self) -> tuple[int, int]:
        """Beams and steps."""
        return len(self.elevations), len(self.azimuths)

    def directions(self, up: float = 0.0, aside: float = 0.0) -> np.ndarray:
        """Unit directions (beams, steps, 3) in the sensor's frame (x right, y forward, z up), by so many radians
        higher and to the right."""
        elevation, azimuth = np.meshgrid(self.elevations + up, self.azimuths, indexing="ij")
        azimuth = azimuth + aside / np.cos(elevation)
        x, y = np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth)
        return np.stack([x, y, np.sin(elevation)], axis=-1)


def scan_pattern(lidar: WorldLidarSettings, revolutions_hz: int) -> ScanPattern:
    """The pattern of a sensor; unless it `spins`, all rays leave at the sweep's timestamp."""
    azimuths = np.linspace(-np.pi, np.pi, STEPS[revolutions_hz], endpoint=False)
    fractions = (FORWARD + azimuths / (2 * np.pi)) % 1.0 - 1.0
    offsets = fractions / revolutions_hz if lidar.spins else np.zeros_like(fractions)
    return ScanPattern(ELEVATIONS[lidar.beams], azimuths, offsets)


def spin_of(revolutions_hz: int) -> list[float]:
    """How a sensor that spins goes round, clockwise: seconds of a revolution, seconds after the sweep's timestamp at
    which it begins, and the azimuth (radians from x to y) at which it does."""
    return [1.0 / revolutions_hz, -1.0 / revolutions_hz, np.pi / 2.0 + 2.0 * np.pi * FORWARD]


@dataclass(frozen=True)
class StreetScan:
    """One revolution; all arrays (beams, steps). `range` without noise in metres, infinite where nothing is hit;
    `intensity` in [0, 1]; `object`, the index of what is hit, NO_HIT otherwise; `measured`, the range with noise;
    `returned`, whether the sensor records it."""

    range: np.ndarray
    intensity: np.ndarray
    object: np.ndarray
    measured: np.ndarray
    returned: np.ndarray


def scan(
    snapshot: StreetSnapshot, pattern: ScanPattern, sensor_to_street: np.ndarray, seconds: np.ndarray,
    lidar: WorldLidarSettings, wet: float, random: np.random.Generator,
) -> StreetScan:  # fmt: skip
    """One revolution. `seconds` (m,) are the times of the pattern's moments, `sensor_to_street` (m, 4, 4) the poses."""
    # upward and sideward angles (radians) of the rays that stand for one beam; the first is its axis
    half = lidar.divergence_mrad / 2000.0
    offsets = [(0.0, 0.0), *(((half, 0.0), (-half, 0.0), (0.0, half), (0.0, -half)) if half else ())]
    found = [_cast(snapshot, pattern, sensor_to_street, seconds, wet, *offset) for offset in offsets]
    distance, power, objects = (np.stack(values) for values in zip(*found, strict=True))
    # the range, reflected fraction and object of each beam's axis, or of its strongest echo where other rays hit a
    # surface nearer or farther; and the range of that echo, the mean of its rays
    echo_power = np.zeros_like(power)
    echo_range = np.zeros_like(distance)
    for ray in range(len(distance)):
        with np.errstate(invalid="ignore"):
            same = np.isfinite(distance) & (np.abs(distance - distance[ray]) < EDGE_GAP)
        weight = np.where(same, power / len(power), 0.0)
        echo_power[ray] = weight.sum(axis=0)
        total = np.maximum(echo_power[ray], 1e-12)
        echo_range[ray] = (weight * np.where(same, distance, 0.0)).sum(axis=0) / total
    best = np.argmax(echo_power + 1e-9 * (np.arange(len(power)) == 0)[:, None, None], axis=0)[None]
    chosen = (np.take_along_axis(a, best, axis=0)[0] for a in (distance, echo_power, objects, echo_range))
    true_range, intensity, hit, echo = chosen
    echo = np.where(intensity > 0.0, echo, true_range)
    weakest = 0.05 * (true_range / MAX_RANGE) ** 2
    in_range = (hit != NO_HIT) & (true_range > MIN_RANGE) & (true_range < MAX_RANGE)
    returned = in_range & (intensity > np.where(in_range, weakest, 0.0) * random.uniform(0.5, 1.5, pattern.shape))
    measured = echo + random.normal(0.0, RANGE_NOISE, pattern.shape)
    return StreetScan(true_range, np.clip(intensity, 0.0, 1.0), hit, measured, returned)


def returns(
    scan: StreetScan, pattern: ScanPattern, sensor_to_street: np.ndarray, at_timestamp: np.ndarray
) -> np.ndarray:
    """The recorded returns (n, 5) float32 of a scan: x, y, z in metres in the sensor's frame at the sweep's timestamp
    (`at_timestamp` (4, 4), sensor to street), intensity 0 to 255, ring. The sensor's own motion is compensated, that of
    objects is not."""
    ring, step = np.nonzero(scan.returned)
    local = scan.measured[ring, step, None] * pattern.directions()[ring, step]
    to_timestamp = (np.linalg.inv(at_timestamp) @ sensor_to_street)[pattern.moments[1]]
    points = np.einsum("nij,nj->ni", to_timestamp[step, :3, :3], local) + to_timestamp[step, :3, 3]
    intensity = (255.0 * scan.intensity[ring, step]).round()
    return np.column_stack([points, intensity, ring]).astype(np.float32)


def _cast(
    snapshot: StreetSnapshot, pattern: ScanPattern, sensor_to_street: np.ndarray, seconds: np.ndarray, wet: float,
    up: float, aside: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Distance in metres, reflected fraction and object of the rays: (beams, steps) each."""
    local = pattern.directions(up, aside)
    of_step = pattern.moments[1]
    directions = np.einsum("sij,bsj->bsi", sensor_to_street[of_step, :3, :3], local).reshape(-1, 3)
    moment = np.tile(of_step, len(pattern.elevations))
    rays = StreetRays(seconds, sensor_to_street[:, :3, 3], directions, moment)
    hits = snapshot.cast(rays)
    reflected, caster = np.zeros(len(rays)), snapshot.caster
    _reflect(
        rays.directions, hits.face, hits.normal, hits.weights, caster.texture, caster.texture_normal, caster.material,
        caster.color, wet, reflected,
    )  # fmt: skip
    return hits.distance.reshape(pattern.shape), reflected.reshape(pattern.shape), hits.object.reshape(pattern.shape)


@compiled
@no_type_check
def _reflect(directions, face, normal, weights, texture, texture_normal, material, color, wet, out):
    """Fills `out` (n,) with the reflected fraction; see `shade` in lighting.py for the arguments."""
    for i in range(len(directions)):
        f = face[i]
        if f < 0:
            continue
        _, _, _, facing = facing_normal(normal[i], directions[i])
        x, y, z = texture_point(texture[f], weights[i])
        base, flat = color[f], texture_normal[f]
        r, g, b, mirror, _ = surface(
            material[f], base[0], base[1], base[2], x, y, z, flat[0], flat[1], flat[2], FOOTPRINT
        )
        out[i] = facing * infrared(material[f], (r + g + b) / 3.0, mirror, facing, wet)


@compiled
@no_type_check
def infrared(material, visible, mirror, facing, wet):
    """Reflectivity at 905 nm of a surface whose mean reflectance to visible light is `visible`.

    Leaves reflect several times as much as visible light, glass transmits, painted metal and wet roads mirror: they
    return light at normal incidence alone. Signs reflect back to the source. Orders of magnitude as in the tables of
    Kashani et al., "A review of LIDAR radiometric processing", Sensors 15 (2015).
    """
    if material == LEAVES:
        return min(0.6, 4.0 * visible)
    if material == SIGN:
        return 1.5
    if material == GLASS:
        return 0.02 + 0.6 * facing**40
    if material in (PAINT, METAL):
        return 0.05 + 0.6 * visible + 0.3 * facing**20
    if material == ROAD_:
        return visible * (1.0 - 0.85 * wet * (1.0 - facing**4))
    return visible * (1.0 - 0.9 * mirror)
