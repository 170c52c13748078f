"""Noise and regular patterns, compiled, filtered by the width of a pixel on the surface (`footprint`, metres).

Details below the footprint fade to their mean and are not computed.
"""

import math
from typing import no_type_check

import numpy as np

from drivesplat.kernels.cache import kernel

compiled = kernel(fastmath=True)


@compiled
@no_type_check
def hash_noise(x, y, z):
    """A pseudo-random number in [0, 1) for integer coordinates."""
    h = np.uint32(np.int64(x) * 73856093 ^ np.int64(y) * 19349663 ^ np.int64(z) * 83492791)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(1274126177)
    return ((h ^ (h >> np.uint32(16))) & np.uint32(0xFFFFFF)) / 16777216.0


@compiled
@no_type_check
def plane_noise(x, y, seed):
    """Value noise in [0, 1) with a wavelength of one unit on a plane, one per integer `seed`."""
    ix, iy = math.floor(x), math.floor(y)
    fx, fy = x - ix, y - iy
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    low = hash_noise(ix, iy, seed) * (1 - fx) + hash_noise(ix + 1, iy, seed) * fx
    high = hash_noise(ix, iy + 1, seed) * (1 - fx) + hash_noise(ix + 1, iy + 1, seed) * fx
    return low * (1 - fy) + high * fy


@compiled
@no_type_check
def value_noise(x, y, z):
    """Value noise in [0, 1) with a wavelength of one unit."""
    iz = math.floor(z)
    fz = (z - iz) ** 2 * (3 - 2 * (z - iz))
    return plane_noise(x, y, iz) * (1 - fz) + plane_noise(x, y, iz + 1) * fz


@compiled
@no_type_check
def visible(wavelength, footprint):
    """Contrast in [0, 1] that remains of a detail of this size: none below a wavelength of one footprint."""
    return min(1.0, max(0.0, wavelength / (2.0 * footprint + 1e-6) - 0.5))


@compiled
@no_type_check
def fractal(x, y, z, wavelength, footprint):
    """Three octaves of noise around 0 (about +-0.5); those finer than the footprint fade out."""
    total, amplitude = 0.0, 0.5
    for octave in range(3):
        contrast = visible(wavelength, footprint)
        if contrast == 0.0:
            break
        shift = 17.3 * octave
        at = value_noise(x / wavelength + shift, y / wavelength + shift, z / wavelength - shift)
        total += contrast * amplitude * (2 * at - 1)
        amplitude *= 0.5
        wavelength *= 0.37
    return total


@compiled
@no_type_check
def grain(x, y, wavelength, footprint):
    """One octave of noise around 0 (+-1) on a plane."""
    contrast = visible(wavelength, footprint)
    return contrast * (2 * plane_noise(x / wavelength, y / wavelength, 40) - 1) if contrast > 0.0 else 0.0


@compiled
@no_type_check
def plane_fractal(x, y, wavelength, footprint):
    """`fractal` on a plane, at half the cost."""
    coarse, middle = grain(x, y, wavelength, footprint), grain(x + 9.1, y, 0.37 * wavelength, footprint)
    return 0.5 * coarse + 0.25 * middle + 0.125 * grain(x, y + 9.1, 0.137 * wavelength, footprint)


@compiled
@no_type_check
def coverage(value, low, high, footprint):
    """Fraction of a pixel at `value` that lies between `low` and `high`."""
    width = footprint + 1e-4
    return min(1.0, max(0.0, (value - low) / width + 0.5)) - min(1.0, max(0.0, (value - high) / width + 0.5))


@compiled
@no_type_check
def stripes(value, period, width, footprint):
    """Fraction of a pixel at `value` that lies in stripes from k * `period` to k * `period` + `width`."""
    half, share = 0.5 * (footprint + 1e-4) / period, width / period
    low, high = value / period - half, value / period + half
    first, last = math.floor(low), math.floor(high)
    covered = ((last - first) * share + min(high - last, share) - min(low - first, share)) / (2 * half)
    return min(1.0, max(0.0, covered))


@compiled
@no_type_check
def tiles(x, y, width, height, joint, footprint):
    """Tiles in running bond: the fraction of a pixel in joints, and a tone around 0 (+-0.5) for each tile."""
    row = math.floor(y / height)
    x += 0.5 * width * (row % 2)
    gaps = 1 - (1 - stripes(x, width, joint, footprint)) * (1 - stripes(y, height, joint, footprint))
    contrast = visible(1.5 * height, footprint)
    return gaps, contrast * (hash_noise(math.floor(x / width), row, 7) - 0.5) if contrast > 0.0 else 0.0


@compiled
@no_type_check
def glyphs(x, y, height, seed, footprint):
    """Fraction of a pixel covered by symmetric letters, within a line from y = 0 to y = `height`."""
    letter = math.floor(x / (0.75 * height))
    i, j = math.floor(4 * (x / (0.75 * height) - letter)), math.floor(5 * y / height)
    drawn = i < 3 and hash_noise(letter, seed, 1) > 0.15 and hash_noise(letter, i % 2 + 4 * j, seed) < 0.55
    return 0.34 + visible(0.25 * height, footprint) * ((1.0 if drawn else 0.0) - 0.34)
