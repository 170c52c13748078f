"""Vectors, rotations and angles in registers."""

import math
from typing import no_type_check

import triton
import triton.language as tl

QUARTER, HALF, WHOLE = tl.constexpr(math.pi / 4.0), tl.constexpr(math.pi / 2.0), tl.constexpr(math.pi)
TAN_EIGHTH = tl.constexpr(math.tan(math.pi / 8.0))


@triton.jit
@no_type_check
def dot(p, q):
    """The inner product of two vectors."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@triton.jit
@no_type_check
def cross(p, q):
    """The cross product of two vectors."""
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@triton.jit
@no_type_check
def scaled(factor, p):
    """A vector times a number."""
    return factor * p[0], factor * p[1], factor * p[2]


@triton.jit
@no_type_check
def times(p, q):
    """The products of the coordinates of two vectors."""
    return p[0] * q[0], p[1] * q[1], p[2] * q[2]


@triton.jit
@no_type_check
def added(p, q):
    """The sum of two vectors."""
    return p[0] + q[0], p[1] + q[1], p[2] + q[2]


@triton.jit
@no_type_check
def turned(rows, p):
    """A vector by the rows of a matrix."""
    return dot(rows[0], p), dot(rows[1], p), dot(rows[2], p)


@triton.jit
@no_type_check
def turned_back(rows, p):
    """A vector by the columns of a matrix, given its rows."""
    return added(scaled(p[0], rows[0]), added(scaled(p[1], rows[1]), scaled(p[2], rows[2])))


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
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@triton.jit
@no_type_check
def rotation_gradient(w, x, y, z, rows):
    """The gradient of a unit quaternion by that of the rows of its rotation matrix."""
    wx, wy, wz = rows[2][1] - rows[1][2], rows[0][2] - rows[2][0], rows[1][0] - rows[0][1]
    xy, xz, yz = rows[0][1] + rows[1][0], rows[0][2] + rows[2][0], rows[1][2] + rows[2][1]
    return (
        2.0 * (x * wx + y * wy + z * wz),
        2.0 * (y * xy + z * xz + w * wx - 2.0 * x * (rows[1][1] + rows[2][2])),
        2.0 * (x * xy + z * yz + w * wy - 2.0 * y * (rows[0][0] + rows[2][2])),
        2.0 * (x * xz + y * yz + w * wz - 2.0 * z * (rows[0][0] + rows[1][1])),
    )


@triton.jit
@no_type_check
def axes_gradient(rows, size, w, x, y, z, length):
    """The gradients of scales and of a quaternion by that of the rows of R S. The unit quaternion w, x, y, z is given
    with its length before normalization."""
    rotation = rotation_rows(w, x, y, z)
    by_size = added(times(rows[0], rotation[0]), added(times(rows[1], rotation[1]), times(rows[2], rotation[2])))
    by_rotation = times(rows[0], size), times(rows[1], size), times(rows[2], size)
    gw, gx, gy, gz = rotation_gradient(w, x, y, z, by_rotation)
    radial = gw * w + gx * x + gy * y + gz * z
    gw, gx, gy, gz = gw - radial * w, gx - radial * x, gy - radial * y, gz - radial * z
    return by_size, (gw / length, gx / length, gy / length, gz / length)


@triton.jit
@no_type_check
def turn_rows(velocity, seconds):
    """The rows of the rotation by an angular velocity over times, after Rodrigues."""
    speed = tl.maximum(tl.sqrt(dot(velocity, velocity)), 1e-12)
    x, y, z = scaled(1.0 / speed, velocity)
    s, c = tl.sin(speed * seconds), tl.cos(speed * seconds)
    k = 1.0 - c
    return (
        (c + k * x * x, k * x * y - s * z, k * x * z + s * y),
        (k * x * y + s * z, c + k * y * y, k * y * z - s * x),
        (k * x * z - s * y, k * y * z + s * x, c + k * z * z),
    )
