"""Rows of arrays of threes and of quaternions, as kernels read and write them."""

from typing import no_type_check

import triton
import triton.language as tl


@triton.jit
@no_type_check
def three(values, i, there):
    """Row i of an array of threes."""
    x = tl.load(values + 3 * i, mask=there, other=0.0)
    y = tl.load(values + 3 * i + 1, mask=there, other=0.0)
    z = tl.load(values + 3 * i + 2, mask=there, other=0.0)
    return x, y, z


@triton.jit
@no_type_check
def store_three(values, i, x, y, z, there):
    tl.store(values + 3 * i, x, mask=there)
    tl.store(values + 3 * i + 1, y, mask=there)
    tl.store(values + 3 * i + 2, z, mask=there)


@triton.jit
@no_type_check
def quaternion(values, i, there):
    """Row i of an array of quaternions."""
    w = tl.load(values + 4 * i, mask=there, other=1.0)
    x = tl.load(values + 4 * i + 1, mask=there, other=0.0)
    y = tl.load(values + 4 * i + 2, mask=there, other=0.0)
    z = tl.load(values + 4 * i + 3, mask=there, other=0.0)
    return w, x, y, z


@triton.jit
@no_type_check
def store_quaternion(values, i, w, x, y, z, there):
    tl.store(values + 4 * i, w, mask=there)
    tl.store(values + 4 * i + 1, x, mask=there)
    tl.store(values + 4 * i + 2, y, mask=there)
    tl.store(values + 4 * i + 3, z, mask=there)


@triton.jit
@no_type_check
def unit(values, i, there):
    """Row i of an array of quaternions, and its length before it was made 1."""
    w, x, y, z = quaternion(values, i, there)
    length = tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return w / length, x / length, y / length, z / length, length
