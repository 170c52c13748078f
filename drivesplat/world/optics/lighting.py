"""Shading, compiled: sun, shadows and sky by day; street lamps, headlights and lit windows by night."""

import math
from typing import NamedTuple, no_type_check

import numpy as np

from drivesplat.world.optics.materials import BARE_ASPHALT, LEAVES, ROAD_, paint, surface
from drivesplat.world.optics.patterns import compiled, fractal, value_noise


class Light(NamedTuple):
    """Light sources in linear units, in the street frame (metres, unit vectors).

    `sun_direction` points to the sun; `bounce` is light from below; `lamps` (m, 3) are positions. `headlight_origin`
    and `headlight_direction` are those of the ego vehicle. `emission` scales the emission of surfaces; `wet` in [0, 1]
    is the share of the road under water.
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
    headlight_origin: np.ndarray
    headlight_direction: np.ndarray
    headlight: float
    emission: float
    wet: float = 0.0


def daylight(random: np.random.Generator) -> Light:
    """Sunlight and some clouds."""
    azimuth, height = random.uniform(0.2, 0.4), math.radians(random.uniform(38, 52))
    sun = np.array([-math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)])
    return Light(
        sun, np.array([2.4, 2.25, 2.0]), np.array([0.55, 0.66, 0.85]), np.array([0.22, 0.2, 0.18]),
        np.array([0.2, 0.4, 0.78]), np.array([0.75, 0.82, 0.9]), 0.8, np.zeros((0, 3)), np.zeros(3),
        np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.0, 0.25,
    )  # fmt: skip


def lamplight(lamps: np.ndarray, ego_to_street: np.ndarray) -> Light:
    """Street lamps at `lamps` (m, 3) and the headlights of the ego vehicle."""
    headlight_origin = ego_to_street[:3, 3] + ego_to_street[:3, :3] @ np.array([3.6, 0.0, 0.7])
    return Light(
        np.array([0.0, 0.0, 1.0]), np.zeros(3), np.array([0.035, 0.04, 0.06]), np.array([0.02, 0.02, 0.02]),
        np.array([0.006, 0.008, 0.02]), np.array([0.05, 0.045, 0.05]), 0.2, lamps, np.array([52.0, 39.0, 24.0]),
        headlight_origin, ego_to_street[:3, 0].copy(), 180.0, 1.0,
    )  # fmt: skip


@compiled
@no_type_check
def sky_color(dx, dy, dz, light):
    """Radiance r, g, b of the sky in a direction."""
    up = max(dz, 0.0)
    blend = 1.0 - math.exp(-4.0 * up)
    r = light.horizon[0] + blend * (light.zenith[0] - light.horizon[0])
    g = light.horizon[1] + blend * (light.zenith[1] - light.horizon[1])
    b = light.horizon[2] + blend * (light.zenith[2] - light.horizon[2])
    if up > 0.0:
        u, v = dx / (up + 0.15), dy / (up + 0.15)
        cover = 0.6 * value_noise(1.3 * u, 1.3 * v, 3.0) + 0.4 * value_noise(3.1 * u, 3.1 * v, 9.0)
        cloud = light.clouds * min(1.0, max(0.0, 3.0 * (cover - 0.5))) * min(1.0, 6.0 * up)
        white = light.horizon[0] + light.horizon[1] + light.horizon[2]
        r += cloud * (0.4 * white - r)
        g += cloud * (0.4 * white - g)
        b += cloud * (0.4 * white - b)
    halo = max(0.0, dot(light.sun_direction, dx, dy, dz)) ** 60
    return r + 0.3 * halo * light.sun[0], g + 0.3 * halo * light.sun[1], b + 0.3 * halo * light.sun[2]


@compiled
@no_type_check
def lamp_irradiance(px, py, pz, nx, ny, nz, light):
    """Irradiance r, g, b of street lamps, which shine down, and headlights at a point p with normal n."""
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
        at = light.headlight_origin
        lx, ly, lz = at[0] - px, at[1] - py, at[2] - pz
        squared = lx * lx + ly * ly + lz * lz + 1.0
        length = math.sqrt(squared)
        along = -dot(light.headlight_direction, lx, ly, lz) / length
        beam = max(0.0, along) ** 24 * max(0.0, (lx * nx + ly * ny + lz * nz) / length)
        r += light.headlight * beam / squared
        g += light.headlight * beam / squared
        b += 0.9 * light.headlight * beam / squared
    return r, g, b


@compiled
@no_type_check
def shade(
    directions, origins, moment, distance, face, normal, weights, lit, texture, texture_normal, material, color,
    pixel_angle, light, out,
):  # fmt: skip
    """Fills `out` (n, 3) with the radiance that arrives along rays `directions` (n, 3) at `origins` (m, 3) of `moment`
    (n,).

    `distance`, `face`, `normal`, `weights`: see `raycast.RayHits`. `texture`, `texture_normal`, `material`, `color`:
    see `raycast.RayCaster`. `lit` (n,): whether the sun is visible from the hit. `pixel_angle`: radians between rays.
    """
    for i in range(len(directions)):
        d, f = directions[i], face[i]
        if f < 0:
            out[i, 0], out[i, 1], out[i, 2] = sky_color(d[0], d[1], d[2], light)
            continue
        far, start = distance[i], origins[moment[i]]
        px, py, pz = start[0] + far * d[0], start[1] + far * d[1], start[2] + far * d[2]
        nx, ny, nz, facing = facing_normal(normal[i], d)
        x, y, z = texture_point(texture[f], weights[i])
        footprint = far * pixel_angle / math.sqrt(facing)
        kind, base, flat = material[f], color[f], texture_normal[f]
        r, g, b, mirror, emission = surface(
            kind, base[0], base[1], base[2], x, y, z, flat[0], flat[1], flat[2], footprint
        )
        if kind == LEAVES:  # leaves have all orientations
            nx += 0.9 * fractal(x, y, z + 5.0, 0.5, footprint)
            ny += 0.9 * fractal(x + 5.0, y, z, 0.5, footprint)
            nz += 0.9 * fractal(x, y + 5.0, z, 0.5, footprint)
        sunny = max(0.0, dot(light.sun_direction, nx, ny, nz)) if lit[i] else 0.0
        lamp = lamp_irradiance(px, py, pz, nx, ny, nz, light)
        up, reflection, fresnel = 0.5 + 0.5 * nz, (0.0, 0.0, 0.0), 0.0
        if kind == ROAD_:  # a film of water
            mirror += light.wet
            r, g, b = r * (1 - 0.5 * light.wet), g * (1 - 0.5 * light.wet), b * (1 - 0.5 * light.wet)
        if mirror > 0.0:  # Schlick's approximation; only the sky is reflected
            fresnel = mirror * (0.05 + 0.95 * (1 - facing) ** 5)
            rx, ry, rz = d[0] + 2 * facing * nx, d[1] + 2 * facing * ny, d[2] + 2 * facing * nz
            reflection = sky_color(rx, ry, rz, light)
            fresnel *= 1.0 if rz > 0 else 0.3
        haze = 1.0 - math.exp(-far / 900.0)
        albedo = (r, g, b)
        for c in range(3):
            ambient = up * light.sky[c] + (1 - up) * light.bounce[c]
            received = sunny * light.sun[c] + ambient + lamp[c] + emission * light.emission
            value = albedo[c] * received + fresnel * reflection[c]
            out[i, c] = value + haze * (light.horizon[c] - value)


@compiled
@no_type_check
def find_paint(face, weights, texture, out):
    """Fills `out` (n,) bool: whether there is paint at places of the road, given as of `shade`."""
    for i in range(len(face)):
        x, y, z = texture_point(texture[face[i]], weights[i])
        out[i] = z >= BARE_ASPHALT and paint(x, y, 0.0) > 0.5


@compiled
@no_type_check
def texture_point(corners, weights):
    """The point x, y, z of a face with `corners` (3, 3) at barycentric `weights` (2,) of the second and the third."""
    u, v = weights[0], weights[1]
    first = 1.0 - u - v
    x = first * corners[0, 0] + u * corners[1, 0] + v * corners[2, 0]
    y = first * corners[0, 1] + u * corners[1, 1] + v * corners[2, 1]
    z = first * corners[0, 2] + u * corners[1, 2] + v * corners[2, 2]
    return x, y, z


@compiled
@no_type_check
def facing_normal(normal, direction):
    """The unit normal x, y, z on the viewer's side, and its cosine to the ray, at least 0.04."""
    length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2) + 1e-30
    nx, ny, nz = normal[0] / length, normal[1] / length, normal[2] / length
    along = dot(direction, nx, ny, nz)
    if along > 0:
        nx, ny, nz = -nx, -ny, -nz
    return nx, ny, nz, max(0.04, abs(along))


@compiled
@no_type_check
def dot(v, x, y, z):
    """Scalar product of the first three elements of `v` with x, y, z."""
    return v[0] * x + v[1] * y + v[2] * z
