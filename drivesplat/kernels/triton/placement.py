"""Objects' Gaussians transformed to the world in one pass, and the gradient in another.

A vector v becomes q v q* = (w² - u·u) v + 2 (u·v) u + 2 w u × v, for the object's quaternion q with real part w and
imaginary part u; a Gaussian's own quaternion b becomes q b. With the inner product of quaternions and a gradient g of
the product a b, the gradients of a and b are g b* and a* g.
"""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.rows import quaternion, store_quaternion, store_three, three, unit

BLOCK = 128
"""Gaussians per program."""


class Placement(torch.autograd.Function):
    """`drivesplat.kernels.placement.place`; takes the fields of its records one after the other."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, *rest: Tensor) -> Any:
        *objects, owner, owns = (values.contiguous() for values in rest)
        local = means, quats, scales, opacities
        placed = tuple(torch.empty_like(values) for values in local)
        count = len(means)
        _place[(triton.cdiv(count, BLOCK),)](*local, *objects, owner, *placed, count, BLOCK)
        ctx.save_for_backward(means, quats, *objects, owner, owns, *placed[2:])
        return placed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, quats, *objects, owner, owns, scales, opacities = ctx.saved_tensors
        v_placed = tuple(values.contiguous() for values in gradients)
        v_local = tuple(torch.empty_like(values) for values in v_placed)
        count = len(means)
        v_owners = means.new_empty(count, 7)
        _place_backward[(triton.cdiv(count, BLOCK),)](
            means, quats, scales, opacities, *objects, owner, *v_placed, *v_local, v_owners, count, BLOCK
        )
        v_objects = owns.mT @ v_owners
        return *v_local, v_objects[:, :4], v_objects[:, 4:], None, None, None, None


@triton.jit
@no_type_check
def _product(aw, ax, ay, az, bw, bx, by, bz):
    """The product of two quaternions."""
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return w, x, y, z


@triton.jit
@no_type_check
def _rotated(w, ux, uy, uz, vx, vy, vz):
    """A vector v rotated by a quaternion."""
    same, along = w * w - ux * ux - uy * uy - uz * uz, 2 * (ux * vx + uy * vy + uz * vz)
    x = same * vx + along * ux + 2 * w * (uy * vz - uz * vy)
    y = same * vy + along * uy + 2 * w * (uz * vx - ux * vz)
    z = same * vz + along * uz + 2 * w * (ux * vy - uy * vx)
    return x, y, z


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _place(
    means, quats, log_scales, logits, object_quats, translations, sizes, presence, owner,
    world_means, world_quats, world_scales, world_opacities, count, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    object_ = tl.load(owner + i, mask=valid, other=0)
    size = tl.load(sizes + object_, mask=valid, other=1.0)
    w, ux, uy, uz = quaternion(object_quats, object_, valid)
    vx, vy, vz = three(means, i, valid)
    x, y, z = _rotated(w, ux, uy, uz, size * vx, size * vy, size * vz)
    to_x, to_y, to_z = three(translations, object_, valid)
    store_three(world_means, i, x + to_x, y + to_y, z + to_z, valid)

    bw, bx, by, bz, _ = unit(quats, i, valid)
    w, x, y, z = _product(w, ux, uy, uz, bw, bx, by, bz)
    store_quaternion(world_quats, i, w, x, y, z, valid)

    x, y, z = three(log_scales, i, valid)
    store_three(world_scales, i, size * tl.exp(x), size * tl.exp(y), size * tl.exp(z), valid)
    opacity = tl.sigmoid(tl.load(logits + i, mask=valid, other=0.0))
    tl.store(world_opacities + i, opacity * tl.load(presence + object_, mask=valid, other=0.0), mask=valid)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _place_backward(
    means, quats, world_scales, world_opacities, object_quats, translations, sizes, presence, owner,
    v_world_means, v_world_quats, v_world_scales, v_world_opacities,
    v_means, v_quats, v_log_scales, v_logits, v_owners, count, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    object_ = tl.load(owner + i, mask=valid, other=0)
    size = tl.load(sizes + object_, mask=valid, other=1.0)
    w, ux, uy, uz = quaternion(object_quats, object_, valid)
    vx, vy, vz = three(means, i, valid)
    vx, vy, vz = size * vx, size * vy, size * vz
    gx, gy, gz = three(v_world_means, i, valid)
    x, y, z = _rotated(w, -ux, -uy, -uz, gx, gy, gz)
    store_three(v_means, i, size * x, size * y, size * z, valid)
    together = gx * vx + gy * vy + gz * vz
    along_g, along_v = ux * gx + uy * gy + uz * gz, ux * vx + uy * vy + uz * vz
    cross_x, cross_y, cross_z = vy * gz - vz * gy, vz * gx - vx * gz, vx * gy - vy * gx
    by_w = 2 * (w * together + ux * cross_x + uy * cross_y + uz * cross_z)
    by_x = 2 * (vx * along_g + gx * along_v - ux * together + w * cross_x)
    by_y = 2 * (vy * along_g + gy * along_v - uy * together + w * cross_y)
    by_z = 2 * (vz * along_g + gz * along_v - uz * together + w * cross_z)

    bw, bx, by, bz, length = unit(quats, i, valid)
    pw, px, py, pz = quaternion(v_world_quats, i, valid)
    aw, ax, ay, az = _product(pw, px, py, pz, bw, -bx, -by, -bz)
    tl.store(v_owners + 7 * i, by_w + aw, mask=valid)
    tl.store(v_owners + 7 * i + 1, by_x + ax, mask=valid)
    tl.store(v_owners + 7 * i + 2, by_y + ay, mask=valid)
    tl.store(v_owners + 7 * i + 3, by_z + az, mask=valid)
    tl.store(v_owners + 7 * i + 4, gx, mask=valid)
    tl.store(v_owners + 7 * i + 5, gy, mask=valid)
    tl.store(v_owners + 7 * i + 6, gz, mask=valid)
    pw, px, py, pz = _product(w, -ux, -uy, -uz, pw, px, py, pz)
    radial = pw * bw + px * bx + py * by + pz * bz
    pw, px, py, pz = pw - radial * bw, px - radial * bx, py - radial * by, pz - radial * bz
    store_quaternion(v_quats, i, pw / length, px / length, py / length, pz / length, valid)

    x, y, z = three(world_scales, i, valid)
    gx, gy, gz = three(v_world_scales, i, valid)
    store_three(v_log_scales, i, x * gx, y * gy, z * gz, valid)
    seen, opacity = (
        tl.load(presence + object_, mask=valid, other=0.0),
        tl.load(world_opacities + i, mask=valid, other=0.0),
    )
    by_opacity = tl.load(v_world_opacities + i, mask=valid, other=0.0)
    tl.store(v_logits + i, by_opacity * opacity * (1.0 - opacity) * seen, mask=valid)
