"""Vectors, rotations and angles in registers."""

import math
from typing import no_type_check

import triton
import triton.language as tl

QUARTER, HALF, WHOLE = tl.constexpr(math.pi / 4.0), tl.constexpr(math.pi / 2.0), tl.constexpr(math.pi)
TAN_EIGHTH = tl.constexpr(math.tan(math.pi / 8.0))


@triton.jit
@no_type_check
def dot(ax, ay, az, bx, by, bz):
    """The inner product of two vectors."""
    return ax * bx + ay * by + az * bz


@triton.jit
@no_type_check
def cross(ax, ay, az, bx, by, bz):
    """The cross product of two vectors."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@triton.jit
@no_type_check
def atan2(y, x):
    """The angle of (x, y) within ±π, with an error of 3e-7; 0 for (0, 0). The polynomial is that of Cephes."""
    wide, high = tl.abs(x), tl.abs(y)
    t = tl.minimum(wide, high) / tl.maximum(tl.maximum(wide, high), 1e-37)
    steep = t > TAN_EIGHTH
    t = tl.where(steep, (t - 1.0) / (t + 1.0), t)
    z = t * t
    series = ((8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1) * z - 3.33329491539e-1
    angle = tl.where(steep, QUARTER, 0.0) + series * z * t + t
    angle = tl.where(high > wide, HALF - angle, angle)
    angle = tl.where(x < 0.0, WHOLE - angle, angle)
    return tl.where(y < 0.0, -angle, angle)


@triton.jit
@no_type_check
def around(angle):
    """An angle between -3π and 3π, within ±π."""
    angle = tl.where(angle > WHOLE, angle - 2.0 * WHOLE, angle)
    return tl.where(angle < -WHOLE, angle + 2.0 * WHOLE, angle)


@triton.jit
@no_type_check
def rotation_rows(w, x, y, z):
    """The rows of the rotation matrix of a unit quaternion."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
@no_type_check
def rotation_gradient(w, x, y, z, g0, g1, g2, g3, g4, g5, g6, g7, g8):
    """The gradient of a unit quaternion by that of the rows of its rotation matrix."""
    return (
        2.0 * (x * (g7 - g5) + y * (g2 - g6) + z * (g3 - g1)),
        2.0 * (y * (g1 + g3) + z * (g2 + g6) + w * (g7 - g5) - 2.0 * x * (g4 + g8)),
        2.0 * (x * (g1 + g3) + z * (g5 + g7) + w * (g2 - g6) - 2.0 * y * (g0 + g8)),
        2.0 * (x * (g2 + g6) + y * (g5 + g7) + w * (g3 - g1) - 2.0 * z * (g0 + g4)),
    )


@triton.jit
@no_type_check
def turn_rows(x, y, z, seconds):
    """The rows of the rotation by an angular velocity over times, after Rodrigues."""
    speed = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-12)
    x, y, z = x / speed, y / speed, z / speed
    s, c = tl.sin(speed * seconds), tl.cos(speed * seconds)
    k = 1.0 - c
    return (
        c + k * x * x, k * x * y - s * z, k * x * z + s * y,
        k * x * y + s * z, c + k * y * y, k * y * z - s * x,
        k * x * z - s * y, k * y * z + s * x, c + k * z * z,
    )  # fmt: skip
