"""Corrections of annotated poses in one kernel, their gradient in another, and rotations of harmonics in a third."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.rows import quaternion, store_quaternion, store_three, three

BLOCK = 256
"""Annotations per program, or per step of one."""
OBJECTS = 32
"""Objects per program."""


class Corrected(torch.autograd.Function):
    """`drivesplat.kernels.object_poses.corrected`."""

    @staticmethod
    def forward(
        ctx: Any, quats: Tensor, translations: Tensor, weights: Tensor, owner: Tensor, yaw: Tensor, shifts: Tensor
    ) -> tuple[Tensor, Tensor]:
        quats, translations, weights, yaw, shifts = (
            values.contiguous() for values in (quats, translations, weights, yaw, shifts)
        )
        turned, moved, halves = torch.empty_like(quats), torch.empty_like(translations), quats.new_empty(len(quats))
        if len(quats):
            _correct[(len(quats),)](
                quats, translations, weights, owner, yaw, shifts, turned, moved, halves, len(yaw), BLOCK
            )
        ctx.save_for_backward(quats, weights, owner, halves)
        return turned, moved

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_turned: Tensor, v_moved: Tensor) -> tuple[Tensor | None, ...]:
        quats, weights, owner, halves = ctx.saved_tensors
        v_yaw, v_shifts = torch.empty_like(weights), weights.new_empty(len(weights), 3)
        if len(weights):
            _correct_backward[(triton.cdiv(len(weights), BLOCK),)](
                quats, weights, owner, halves, v_turned.contiguous(), v_moved.contiguous(), v_yaw, v_shifts,
                len(weights), BLOCK,
            )  # fmt: skip
        return None, None, None, None, v_yaw, v_shifts


def rotation_of_harmonics(quats: Tensor, coefficients: int) -> Tensor:
    """`drivesplat.model.harmonics.rotation_of_harmonics` of 1 or 4 coefficients, by unit quaternions (a, 4), without
    gradient."""
    count = len(quats)
    maps = quats.new_empty(count, coefficients, coefficients)
    if count:
        _rotate_harmonics[(triton.cdiv(count, OBJECTS),)](quats.contiguous(), maps, count, coefficients, OBJECTS)
    return maps


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _correct(
    quats, translations, weights, owner, yaw, shifts, turned, moved, halves, count, BLOCK: tl.constexpr
):  # fmt: skip
    """Corrects the pose of one object; writes half its angle to `halves`."""
    object_ = tl.program_id(0)
    angle, x = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    y, z = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for begin in range(0, count, BLOCK):
        i = begin + tl.arange(0, BLOCK)
        own = tl.load(owner + i, mask=i < count, other=-1) == object_
        weight = tl.load(weights + i, mask=own, other=0.0)
        by_x, by_y, by_z = three(shifts, i, own)
        angle += weight * tl.load(yaw + i, mask=own, other=0.0)
        x, y, z = x + weight * by_x, y + weight * by_y, z + weight * by_z
    half = 0.5 * tl.sum(angle)
    qw, qx, qy, qz = quaternion(quats, object_, True)
    c, s = tl.cos(half), tl.sin(half)
    store_quaternion(turned, object_, qw * c - qz * s, qx * c + qy * s, qy * c - qx * s, qz * c + qw * s, True)
    to_x, to_y, to_z = three(translations, object_, True)
    store_three(moved, object_, to_x + tl.sum(x), to_y + tl.sum(y), to_z + tl.sum(z), True)
    tl.store(halves + object_, half)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _correct_backward(
    quats, weights, owner, halves, v_turned, v_moved, v_yaw, v_shifts, count, BLOCK: tl.constexpr
):  # fmt: skip
    """Writes the gradients of annotations."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    weight, object_ = tl.load(weights + i, mask=inside, other=0.0), tl.load(owner + i, mask=inside, other=0)
    half = tl.load(halves + object_, mask=inside, other=0.0)
    c, s = tl.cos(half), tl.sin(half)
    qw, qx, qy, qz = quaternion(quats, object_, inside)
    vw, vx, vy, vz = quaternion(v_turned, object_, inside)
    by_half = vx * (qy * c - qx * s) - vw * (qw * s + qz * c) - vy * (qy * s + qx * c) + vz * (qw * c - qz * s)
    tl.store(v_yaw + i, 0.5 * weight * by_half, mask=inside)
    x, y, z = three(v_moved, object_, inside)
    store_three(v_shifts, i, weight * x, weight * y, weight * z, inside)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _rotate_harmonics(quats, maps, count, K: tl.constexpr, OBJECTS: tl.constexpr):
    """Writes maps of coefficients. Those of degree 1 are the components of a vector along -y, z and -x."""
    i = tl.program_id(0) * OBJECTS + tl.arange(0, OBJECTS)
    inside, at = i < count, maps + K * K * i
    if K == 1:
        tl.store(at, 1.0, mask=inside)
    else:
        w, x, y, z = quaternion(quats, i, inside)
        tl.store(at, 1.0, mask=inside)
        for k in tl.static_range(1, 4):
            tl.store(at + k, 0.0, mask=inside)
            tl.store(at + 4 * k, 0.0, mask=inside)
        store_three(at + 5, 0, w * w - x * x + y * y - z * z, 2 * (w * x - y * z), 2 * (x * y + w * z), inside)
        store_three(at + 9, 0, -2 * (y * z + w * x), w * w - x * x - y * y + z * z, 2 * (w * y - x * z), inside)
        store_three(at + 13, 0, 2 * (x * y - w * z), -2 * (x * z + w * y), w * w + x * x - y * y - z * z, inside)
