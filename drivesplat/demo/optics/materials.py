"""Procedural textures, compiled: colour, mirror reflectance and emission of a surface as functions of position.

Textures are filtered by the size of a pixel on the surface (`footprint`, metres): details below it fade to their mean
and do not flicker.
"""

import math
from typing import no_type_check

import numpy as np

from drivesplat.demo.shapes.mesh import Material
from drivesplat.demo.street.layout import CROSSING, CURB, LANE, ROAD, SIDEWALK, WINDOW
from drivesplat.kernels.cache import kernel

compiled = kernel(fastmath=True)

PLAIN, ROAD_, FACADE, LEAVES, PAINT, GLASS, LAMP, CLOTH, STRIPES, METAL_, SIGN_ = (int(m) for m in Material)


@compiled
@no_type_check
def hash_noise(x, y, z):
    """A pseudo-random number in [0, 1) for integer coordinates."""
    h = np.uint32(np.int64(x) * 73856093 ^ np.int64(y) * 19349663 ^ np.int64(z) * 83492791)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(1274126177)
    return ((h ^ (h >> np.uint32(16))) & np.uint32(0xFFFFFF)) / 16777216.0


@compiled
@no_type_check
def value_noise(x, y, z):
    """Value noise in [0, 1) with a wavelength of one unit."""
    ix, iy, iz = math.floor(x), math.floor(y), math.floor(z)
    fx, fy, fz = x - ix, y - iy, z - iz
    fx, fy, fz = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy), fz * fz * (3 - 2 * fz)
    value = 0.0
    for dz in range(2):
        wz = fz if dz else 1 - fz
        for dy in range(2):
            wy = fy if dy else 1 - fy
            row = hash_noise(ix, iy + dy, iz + dz) * (1 - fx) + hash_noise(ix + 1, iy + dy, iz + dz) * fx
            value += wz * wy * row
    return value


@compiled
@no_type_check
def fractal(x, y, z, wavelength, footprint):
    """Three octaves of noise around 0 (about +-0.5); those finer than the footprint fade out."""
    total, amplitude = 0.0, 0.5
    for octave in range(3):
        visible = min(1.0, max(0.0, wavelength / (2.0 * footprint + 1e-6) - 0.5))
        if visible > 0.0:
            shift = 17.3 * octave
            at = value_noise(x / wavelength + shift, y / wavelength + shift, z / wavelength - shift)
            total += visible * amplitude * (2 * at - 1)
        amplitude *= 0.5
        wavelength *= 0.37
    return total


@compiled
@no_type_check
def coverage(value, low, high, footprint):
    """Fraction of a pixel at `value` that lies between `low` and `high`."""
    width = footprint + 1e-4
    return min(1.0, max(0.0, (value - low) / width + 0.5)) - min(1.0, max(0.0, (value - high) / width + 0.5))


@compiled
@no_type_check
def ground(x, y, footprint):
    """Linear reflectance of road, markings, curb, sidewalk and grass."""
    a = abs(y)
    if a > SIDEWALK:
        tone = 1.0 + 0.7 * fractal(x, y, 0.0, 3.0, footprint)
        return 0.11 * tone, 0.17 * tone, 0.05 * tone
    if a > CURB:
        row, column = math.floor(x / 0.9), math.floor(y / 0.9)
        joint = max(coverage(x - 0.9 * row, -0.02, 0.02, footprint), coverage(y - 0.9 * column, -0.02, 0.02, footprint))
        fade = min(1.0, 0.5 / (footprint + 1e-6))
        tone = 0.3 * (1 + fade * 0.25 * (hash_noise(row, column, 7) - 0.5) + 0.2 * fractal(x, y, 1.0, 1.5, footprint))
        tone *= 1 - 0.6 * joint
        return tone, 0.97 * tone, 0.92 * tone
    if a > ROAD:
        tone = 0.36 * (1 + 0.2 * fractal(x, y, 2.0, 1.0, footprint))
        return tone, tone, 0.98 * tone
    tone = 0.085 * (1 + 0.5 * fractal(x, y, 3.0, 3.0, footprint) + 0.5 * fractal(x, y, 4.0, 0.5, footprint))
    cell = math.floor(x / 11.0)
    if hash_noise(cell, 0, 11) < 0.5:  # a repaired patch
        at = 11.0 * cell + 6.0 * hash_noise(cell, 1, 11)
        side = 5.0 * hash_noise(cell, 2, 11) - 3.5
        patch = coverage(x, at, at + 2.5, footprint) * coverage(y, side, side + 1.7, footprint)
        tone *= 1 - 0.4 * patch
    white = coverage(a, LANE - 0.08, LANE + 0.08, footprint)
    dash = x - 6.0 * math.floor(x / 6.0)
    white = max(white, coverage(a, -0.08, 0.08, footprint) * coverage(dash, 0.0, 3.0, footprint))
    if CROSSING[0] - 1 < x < CROSSING[1] + 1:
        stripe = y - math.floor(y)
        white = max(white, coverage(x, CROSSING[0], CROSSING[1], footprint) * coverage(stripe, 0.0, 0.5, footprint))
    worn = white * (0.85 + 0.25 * fractal(x, y, 5.0, 0.6, footprint))
    tone = tone * (1 - worn) + 0.6 * worn
    return tone, tone, 1.03 * tone


@compiled
@no_type_check
def facade(r, g, b, along, z, footprint):
    """A wall with windows: reflectance r, g, b, mirror reflectance, emission at night."""
    column, floor = math.floor(along / WINDOW[0]), math.floor(z / WINDOW[1])
    u, v = along / WINDOW[0] - column, z / WINDOW[1] - floor
    shop = floor == 0
    low, high, sill, top = (0.08, 0.92, 0.12, 0.85) if shop else (0.25, 0.75, 0.3, 0.82)
    fu, fv = footprint / WINDOW[0], footprint / WINDOW[1]
    frame = coverage(u, low - 0.05, high + 0.05, fu) * coverage(v, sill - 0.05, top + 0.05, fv)
    pane = coverage(u, low, high, fu) * coverage(v, sill, top, fv)
    pane *= 1 - 0.8 * coverage(u, 0.49, 0.51, fu)
    wall = 1 + 0.3 * fractal(along, z, 9.0, 2.0, footprint) + 0.15 * fractal(along, 4 * z, 8.0, 0.4, footprint)
    trim = frame - pane * frame
    inside = 0.03 + 0.1 * hash_noise(column, floor, 5)
    r = r * wall * (1 - frame) + 0.55 * trim + inside * pane
    g = g * wall * (1 - frame) + 0.54 * trim + inside * pane
    b = b * wall * (1 - frame) + 0.5 * trim + 1.2 * inside * pane
    lit = 0.5 * pane if shop or hash_noise(column, floor, 6) < 0.3 else 0.0
    return r, g, b, pane, lit


@compiled
@no_type_check
def surface(material, r, g, b, x, y, z, nx, ny, nz, footprint):
    """Reflectance r, g, b, mirror reflectance and emission at night of a point with normal n in the object's frame."""
    if material == ROAD_:
        r, g, b = ground(x, y, footprint)
        return r, g, b, 0.0, 0.0
    if material == FACADE:
        return facade(r, g, b, y if abs(nx) > abs(ny) else x, z, footprint)
    if material == STRIPES and 0.25 < z < 0.42:
        return 0.75, 0.75, 0.75, 0.0, 0.0
    tone, mirror, emission = 1.0, 0.0, 0.0
    if material == LEAVES:
        tone = max(0.15, 1.0 + 1.1 * fractal(x, y, z, 0.9, footprint))
    elif material == PAINT:
        mirror = 1.0
        if abs(ny) > 0.6:  # the seams of doors
            for at in (-0.95, 0.0, 0.85):
                tone = min(tone, 1 - 0.7 * coverage(x, at - 0.012, at + 0.012, footprint))
    elif material == GLASS:
        mirror = 1.0
    elif material == LAMP:
        mirror, emission = 0.3, 1.5
    elif material == CLOTH:
        tone = 1.0 + 0.5 * fractal(x, y, z, 0.25, footprint)
    else:
        tone = 1.0 + 0.2 * fractal(x, y, z, 0.7, footprint)
    return r * tone, g * tone, b * tone, mirror, emission
