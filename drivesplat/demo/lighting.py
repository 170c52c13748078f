"""Light on surfaces, compiled: sun, shadows and sky by day; lamps, headlights and lit windows by night."""

import math
from typing import NamedTuple, no_type_check

import numpy as np

from drivesplat.demo.materials import LEAVES, compiled, mottle, noise, surface


class Light(NamedTuple):
    """What shines, in linear units; directions are unit vectors in street coordinates, places metres.

    `sun_direction` points to the sun. `lamps` (m, 3). `headlight_at`, `headlight_along`: the own car's.
    """

    sun_direction: np.ndarray
    sun: np.ndarray
    sky: np.ndarray
    bounce: np.ndarray
    zenith: np.ndarray
    horizon: np.ndarray
    clouds: float
    lamps: np.ndarray
    lamp: np.ndarray
    headlight_at: np.ndarray
    headlight_along: np.ndarray
    headlight: float
    glow: float


def daylight(random: np.random.Generator) -> Light:
    """A sunny day with some clouds."""
    azimuth, height = random.uniform(0.2, 0.4), math.radians(random.uniform(38, 52))
    sun = np.array([-math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)])
    return Light(
        sun, np.array([2.4, 2.25, 2.0]), np.array([0.55, 0.66, 0.85]), np.array([0.22, 0.2, 0.18]),
        np.array([0.2, 0.4, 0.78]), np.array([0.75, 0.82, 0.9]), 0.8, np.zeros((0, 3)), np.zeros(3),
        np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.0, 0.25,
    )  # fmt: skip


def lamplight(lamps: np.ndarray, ego_to_street: np.ndarray) -> Light:
    """A night under `lamps` (m, 3), with the headlights of the own car."""
    headlight_at = ego_to_street[:3, 3] + ego_to_street[:3, :3] @ np.array([3.6, 0.0, 0.7])
    return Light(
        np.array([0.0, 0.0, 1.0]), np.zeros(3), np.array([0.035, 0.04, 0.06]), np.array([0.02, 0.02, 0.02]),
        np.array([0.006, 0.008, 0.02]), np.array([0.05, 0.045, 0.05]), 0.2, lamps, np.array([26.0, 19.0, 11.0]),
        headlight_at, ego_to_street[:3, 0].copy(), 90.0, 1.0,
    )  # fmt: skip


@compiled
@no_type_check
def sky_color(dx, dy, dz, light):
    """The radiance r, g, b of the sky in a direction."""
    up = max(dz, 0.0)
    blend = 1.0 - math.exp(-4.0 * up)
    r = light.horizon[0] + blend * (light.zenith[0] - light.horizon[0])
    g = light.horizon[1] + blend * (light.zenith[1] - light.horizon[1])
    b = light.horizon[2] + blend * (light.zenith[2] - light.horizon[2])
    if up > 0.0:
        u, v = dx / (up + 0.15), dy / (up + 0.15)
        cover = 0.6 * noise(1.3 * u, 1.3 * v, 3.0) + 0.4 * noise(3.1 * u, 3.1 * v, 9.0)
        cloud = light.clouds * min(1.0, max(0.0, 3.0 * (cover - 0.5))) * min(1.0, 6.0 * up)
        white = light.horizon[0] + light.horizon[1] + light.horizon[2]
        r += cloud * (0.4 * white - r)
        g += cloud * (0.4 * white - g)
        b += cloud * (0.4 * white - b)
    toward = dx * light.sun_direction[0] + dy * light.sun_direction[1] + dz * light.sun_direction[2]
    halo = max(0.0, toward) ** 60
    return r + 0.3 * halo * light.sun[0], g + 0.3 * halo * light.sun[1], b + 0.3 * halo * light.sun[2]


@compiled
@no_type_check
def lamps_at(px, py, pz, nx, ny, nz, light):
    """The irradiance r, g, b of street lamps (shining down) and headlights at a point."""
    r = g = b = 0.0
    for i in range(len(light.lamps)):
        lx, ly, lz = light.lamps[i, 0] - px, light.lamps[i, 1] - py, light.lamps[i, 2] - pz
        squared = lx * lx + ly * ly + lz * lz + 1.0
        length = math.sqrt(squared)
        facing = max(0.0, (lx * nx + ly * ny + lz * nz) / length) * max(0.0, lz / length)
        r += light.lamp[0] * facing / squared
        g += light.lamp[1] * facing / squared
        b += light.lamp[2] * facing / squared
    if light.headlight > 0.0:
        lx, ly, lz = light.headlight_at[0] - px, light.headlight_at[1] - py, light.headlight_at[2] - pz
        squared = lx * lx + ly * ly + lz * lz + 1.0
        length = math.sqrt(squared)
        along = (
            -(lx * light.headlight_along[0] + ly * light.headlight_along[1] + lz * light.headlight_along[2]) / length
        )
        beam = max(0.0, along) ** 24 * max(0.0, (lx * nx + ly * ny + lz * nz) / length)
        r += light.headlight * beam / squared
        g += light.headlight * beam / squared
        b += 0.9 * light.headlight * beam / squared
    return r, g, b


@compiled
@no_type_check
def shade(directions, origin, distance, thing, face, normal, lit, to_body, material, color, pixel_angle, light, out):
    """Fills `out` (n, 3) with the radiance that comes along rays `directions` (n, 3) to `origin` (3,).

    `distance`, `thing`, `face`, `normal`: as in `raycast.Hits`; `lit` (n,): whether the sun's light comes there;
    `to_body`, `material`, `color`: as in `raycast.Stage`. `pixel_angle` is the angle in radians between the rays.
    """
    for i in range(len(directions)):
        d = directions[i]
        if thing[i] < 0:
            out[i, 0], out[i, 1], out[i, 2] = sky_color(d[0], d[1], d[2], light)
            continue
        far = distance[i]
        px, py, pz = origin[0] + far * d[0], origin[1] + far * d[1], origin[2] + far * d[2]
        nx, ny, nz, facing = facing_normal(normal[i], d)
        m = to_body[thing[i]]
        x, y, z = turned(m, px, py, pz)
        x, y, z = x + m[0, 3], y + m[1, 3], z + m[2, 3]
        footprint = far * pixel_angle / math.sqrt(facing)
        kind, base = material[face[i]], color[face[i]]
        r, g, b, mirror, glow = surface(kind, base[0], base[1], base[2], x, y, z, *turned(m, nx, ny, nz), footprint)
        if kind == LEAVES:  # they face every way
            nx += 0.9 * mottle(x, y, z + 5.0, 0.5, footprint)
            ny += 0.9 * mottle(x + 5.0, y, z, 0.5, footprint)
            nz += 0.9 * mottle(x, y + 5.0, z, 0.5, footprint)
        toward_sun = nx * light.sun_direction[0] + ny * light.sun_direction[1] + nz * light.sun_direction[2]
        sunny = max(0.0, toward_sun) if lit[i] else 0.0
        lamp = lamps_at(px, py, pz, nx, ny, nz, light)
        up, gleam = 0.5 + 0.5 * nz, (0.0, 0.0, 0.0)
        share = 0.0
        if mirror > 0.0:  # Schlick's Fresnel term, of the sky alone
            share = mirror * (0.05 + 0.95 * (1 - facing) ** 5)
            rx, ry, rz = d[0] + 2 * facing * nx, d[1] + 2 * facing * ny, d[2] + 2 * facing * nz
            gleam = sky_color(rx, ry, rz, light)
            share *= 1.0 if rz > 0 else 0.3
        haze = 1.0 - math.exp(-far / 900.0)
        albedo = (r, g, b)
        for c in range(3):
            ambient = up * light.sky[c] + (1 - up) * light.bounce[c]
            value = albedo[c] * (sunny * light.sun[c] + ambient + lamp[c] + glow * light.glow) + share * gleam[c]
            out[i, c] = value + haze * (light.horizon[c] - value)


@compiled
@no_type_check
def facing_normal(normal, direction):
    """The unit normal turned to the viewer, x, y, z, and the cosine (at least 0.04) between the two."""
    length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2) + 1e-30
    nx, ny, nz = normal[0] / length, normal[1] / length, normal[2] / length
    along = nx * direction[0] + ny * direction[1] + nz * direction[2]
    if along > 0:
        nx, ny, nz = -nx, -ny, -nz
    return nx, ny, nz, max(0.04, abs(along))


@compiled
@no_type_check
def turned(m, x, y, z):
    """A direction turned by the rotation in `m` (4, 4)."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )
