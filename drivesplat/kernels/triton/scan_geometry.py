"""Gaussians in a LiDAR's frame when the beams meet them, their spherical coordinates, and the gradients of these."""

from typing import no_type_check

import triton
import triton.language as tl

from drivesplat.kernels.scanned_gaussians import MIN_RANGE, MIN_SINE_SQUARED, SINE_OF_POLES
from drivesplat.kernels.triton.rows import three, unit
from drivesplat.kernels.triton.vectors import (
    added,
    cross,
    dot,
    rotation_rows,
    scaled,
    times,
    turn_rows,
    turned,
    turned_back,
)

TINY = tl.constexpr(1.1754943508222875e-38)
"""The smallest normal number of float32."""
MIN_SINE, SINE_LIMIT, NEAREST = tl.constexpr(MIN_SINE_SQUARED), tl.constexpr(SINE_OF_POLES), tl.constexpr(MIN_RANGE)


@triton.jit
@no_type_check
def _vector(source):
    return tl.load(source), tl.load(source + 1), tl.load(source + 2)


@triton.jit
@no_type_check
def _rotation(view):
    """The rows of the rotation from world to sensor."""
    return _vector(view), _vector(view + 3), _vector(view + 6)


@triton.jit
@no_type_check
def at_timestamp(means, velocities, view, i, valid, MOVING: tl.constexpr):
    """Centres in the sensor's frame at the timestamp, and their velocities relative to the sensor."""
    rotation = _rotation(view)
    velocity = scaled(-1.0, _vector(view + 12))
    if MOVING:
        velocity = added(velocity, turned(rotation, three(velocities, i, valid)))
    return added(turned(rotation, three(means, i, valid)), _vector(view + 9)), velocity


@triton.jit
@no_type_check
def turn_of(view, offset):
    """The rows of the rotation from the sensor's frame at the timestamp to that at other times."""
    return turn_rows(scaled(-1.0, _vector(view + 15)), offset)


@triton.jit
@no_type_check
def offsets_at(azimuth, middles, offsets_s, count, steps):
    """The times of the firings nearest to azimuths, by a binary search."""
    low, high = tl.zeros_like(azimuth).to(tl.int32), tl.zeros_like(azimuth).to(tl.int32) + count
    for _ in range(steps):
        middle = (low + high) // 2
        below = (low < high) & (tl.load(middles + middle, mask=middle < count, other=float("inf")) < azimuth)
        low, high = tl.where(below, middle + 1, low), tl.where(below, high, middle)
    return tl.load(offsets_s + low)


@triton.jit
@no_type_check
def met(
    means, quats, scales, view, velocities, offset, i, valid, max_range, WITH_MOTION: tl.constexpr, MOVING: tl.constexpr
):
    """Gaussians when the beams meet them: their centres, whether they are seen, their axes by coordinate; the rows of
    their rotation in the world, and of that from the world to the sensor then."""
    center, velocity = at_timestamp(means, velocities, view, i, valid, MOVING)
    to_sensor = _rotation(view)
    if WITH_MOTION:
        turn = turn_of(view, offset)
        center = turned(turn, added(center, scaled(offset, velocity)))
        to_sensor = turned_back(to_sensor, turn[0]), turned_back(to_sensor, turn[1]), turned_back(to_sensor, turn[2])
    distance = tl.sqrt(dot(center, center))
    seen = valid & (distance >= NEAREST) & (distance <= max_range)
    seen &= tl.abs(center[2]) <= SINE_LIMIT * tl.maximum(distance, NEAREST)
    center = tl.where(seen, center[0], 1.0), tl.where(seen, center[1], 0.0), tl.where(seen, center[2], 0.0)
    w, x, y, z, _ = unit(quats, i, valid)
    rotation, size = rotation_rows(w, x, y, z), three(scales, i, valid)
    x_axis, y_axis, z_axis = (
        turned_back(rotation, to_sensor[0]), turned_back(rotation, to_sensor[1]), turned_back(rotation, to_sensor[2])
    )  # fmt: skip
    axes = times(x_axis, size), times(y_axis, size), times(z_axis, size)
    return center, seen, axes, rotation, to_sensor


@triton.jit
@no_type_check
def spherical(center, axes):
    """Squared distance from the sensor's axis, its root, and the range; the axes outward, and the rows a, e and d."""
    x, y, z = center
    squared = x * x + y * y
    across, r = tl.sqrt(squared), tl.sqrt(squared + z * z)
    outward = added(scaled(x, axes[0]), scaled(y, axes[1]))
    a = scaled(1.0 / squared, added(scaled(x, axes[1]), scaled(-y, axes[0])))
    e = scaled(1.0 / (r * r * across), added(scaled(squared, axes[2]), scaled(-z, outward)))
    d = scaled(1.0 / r, added(outward, scaled(z, axes[2])))
    return squared, across, r, outward, a, e, d


@triton.jit
@no_type_check
def determinant_of(a, e, normal, spread_a, spread_e):
    """The area of the footprint, the determinant of the widened one, and whether the Gaussian has a slope."""
    aa, ee, area = dot(a, a), dot(e, e), dot(normal, normal)
    wide_a, wide_e = spread_a * spread_a, spread_e * spread_e
    determinant = tl.maximum(area + wide_e * aa + wide_a * ee + wide_a * wide_e, TINY)
    return area, determinant, (area > MIN_SINE * aa * ee) & (area > 0.0)


@triton.jit
@no_type_check
def footprint_backward(a, e, d, by_conics, by_slopes, spread_a, spread_e):
    """The gradients of the rows a, e and d by those of conics and slopes."""
    normal = cross(a, e)
    area, determinant, sloped = determinant_of(a, e, normal, spread_a, spread_e)
    wide_a, wide_e = dot(a, a) + spread_a * spread_a, dot(e, e) + spread_e * spread_e
    by_determinant = by_conics[0] * wide_e - by_conics[1] * dot(a, e) + by_conics[2] * wide_a
    by_determinant = -by_determinant / determinant / determinant
    by_aa = by_conics[2] / determinant + spread_e * spread_e * by_determinant
    by_ee = by_conics[0] / determinant + spread_a * spread_a * by_determinant
    by_ae = -by_conics[1] / determinant
    # slopes: normal · (d x e) / area and normal · (a x d) / area
    safe = tl.where(sloped, area, 1.0)
    by_first, by_second = (
        tl.where(sloped, by_slopes[0], 0.0) / safe, tl.where(sloped, by_slopes[1], 0.0) / safe
    )  # fmt: skip
    by_normal = added(scaled(by_first, cross(d, e)), scaled(by_second, cross(a, d)))
    by_area = by_determinant - dot(normal, by_normal) / safe
    by_normal = added(by_normal, scaled(2.0 * by_area, normal))
    first, second = scaled(by_first, normal), scaled(by_second, normal)
    by_a = added(cross(e, by_normal), added(cross(d, second), added(scaled(2.0 * by_aa, a), scaled(by_ae, e))))
    by_e = added(cross(by_normal, a), added(cross(first, d), added(scaled(2.0 * by_ee, e), scaled(by_ae, a))))
    return by_a, by_e, added(cross(e, first), cross(second, a))


@triton.jit
@no_type_check
def spherical_backward(center, axes, by_a, by_e, by_d, by_azimuth, by_elevation, by_range):
    """The gradients of centres and axes in the sensor's frame."""
    x, y, z = center
    squared, across, r, outward, a, e, d = spherical(center, axes)
    low, up = 1.0 / (r * r * across), z / r
    by_outward = added(scaled(1.0 / r, by_d), scaled(-z * low, by_e))
    by_x_axis = added(scaled(x, by_outward), scaled(-y / squared, by_a))
    by_y_axis = added(scaled(y, by_outward), scaled(x / squared, by_a))
    by_z_axis = added(scaled(squared * low, by_e), scaled(up, by_d))
    along_e = dot(by_e, e)
    by_r = by_range - (2.0 * along_e + dot(by_d, d)) / r
    by_across = -along_e / across - z / (r * r) * by_elevation
    by_squared = dot(by_e, axes[2]) * low - dot(by_a, a) / squared + 0.5 * by_across / across + 0.5 * by_r / r
    by_x = dot(by_a, axes[1]) / squared + dot(by_outward, axes[0]) + 2.0 * x * by_squared - y / squared * by_azimuth
    by_y = dot(by_outward, axes[1]) - dot(by_a, axes[0]) / squared + 2.0 * y * by_squared + x / squared * by_azimuth
    by_z = dot(by_d, axes[2]) / r - dot(by_e, outward) * low + across / (r * r) * by_elevation + up * by_r
    return (by_x, by_y, by_z), (by_x_axis, by_y_axis, by_z_axis)
