"""Loads and stores of the rows of (n, 2), (n, 3) and (n, 4) arrays, and sums in place."""

from typing import no_type_check

import triton
import triton.language as tl

ALIGNED = 4
"""Values of 32 bits in 16 bytes. Arrays that share memory begin at multiples of it: for other addresses Triton compiles
another kernel."""


@triton.jit
@no_type_check
def two(values, i, valid):
    """Row i of an (n, 2) array."""
    return tl.load(values + 2 * i, mask=valid, other=0.0), tl.load(values + 2 * i + 1, mask=valid, other=0.0)


@triton.jit
@no_type_check
def three(values, i, valid):
    """Row i of an (n, 3) array."""
    x = tl.load(values + 3 * i, mask=valid, other=0.0)
    y = tl.load(values + 3 * i + 1, mask=valid, other=0.0)
    z = tl.load(values + 3 * i + 2, mask=valid, other=0.0)
    return x, y, z


@triton.jit
@no_type_check
def store_two(values, i, x, y, valid):
    tl.store(values + 2 * i, x, mask=valid)
    tl.store(values + 2 * i + 1, y, mask=valid)


@triton.jit
@no_type_check
def store_three(values, i, x, y, z, valid):
    tl.store(values + 3 * i, x, mask=valid)
    tl.store(values + 3 * i + 1, y, mask=valid)
    tl.store(values + 3 * i + 2, z, mask=valid)


@triton.jit
@no_type_check
def quaternion(values, i, valid):
    """Row i of an array of quaternions."""
    w = tl.load(values + 4 * i, mask=valid, other=1.0)
    x = tl.load(values + 4 * i + 1, mask=valid, other=0.0)
    y = tl.load(values + 4 * i + 2, mask=valid, other=0.0)
    z = tl.load(values + 4 * i + 3, mask=valid, other=0.0)
    return w, x, y, z


@triton.jit
@no_type_check
def store_quaternion(values, i, w, x, y, z, valid):
    tl.store(values + 4 * i, w, mask=valid)
    tl.store(values + 4 * i + 1, x, mask=valid)
    tl.store(values + 4 * i + 2, y, mask=valid)
    tl.store(values + 4 * i + 3, z, mask=valid)


@triton.jit
@no_type_check
def unit(values, i, valid):
    """Row i of an array of quaternions, normalized, and its length before."""
    w, x, y, z = quaternion(values, i, valid)
    length = tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return w / length, x / length, y / length, z / length, length


@triton.jit
@no_type_check
def add_nonzero(total, value, inside):
    """Adds values other than 0."""
    tl.atomic_add(total, value, mask=inside & (value != 0.0), sem="relaxed")
