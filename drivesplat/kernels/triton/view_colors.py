"""The colors that one camera sees of Gaussians, by harmonics up to degree 1, in one pass, and their gradient."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.spherical_harmonics import SH_C0

BLOCK = 64
"""Gaussians per program."""
CONSTANT, LINEAR = tl.constexpr(SH_C0), tl.constexpr(0.4886025119029199)
"""The factors of the functions of degree 0 and 1. Those of degree 1 are -y, z and -x of the direction, in this order,
as in 3D Gaussian Splatting."""


class TritonViewColors(torch.autograd.Function):
    """`drivesplat.kernels.view_colors.fused_view_colors`, without gradient for the camera."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, sh0: Tensor, shN: Tensor, camera_to_world: Tensor, degree: int) -> Tensor:
        means, sh0, shN, camera = (values.contiguous() for values in (means, sh0, shN, camera_to_world))
        count, others = shN.shape[:2]
        colors = means.new_empty(count, 3)
        if count:
            _colors[(triton.cdiv(count, BLOCK),)](means, sh0, shN, camera, colors, count, others, degree, BLOCK)
        ctx.save_for_backward(means, shN, camera, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        means, shN, camera, colors = ctx.saved_tensors
        count, others = shN.shape[:2]
        v_means, v_sh0 = torch.empty_like(means), means.new_empty(count, 1, 3)
        v_shN = torch.empty_like(shN) if ctx.degree == 1 and others == 3 else torch.zeros_like(shN)
        v_colors = v_colors if v_colors.stride(1) == 1 else v_colors.contiguous()  # columns of more are not copied
        if count:
            _colors_backward[(triton.cdiv(count, BLOCK),)](
                means, shN, camera, colors, v_colors, v_means, v_sh0, v_shN,
                count, v_colors.stride(0), others, ctx.degree, BLOCK,
            )  # fmt: skip
        return v_means, v_sh0, v_shN, None, None


# Index k is that of a function of degree 1, channel that of a color; both are padded from 3 to 4. Neighbouring threads
# have neighbouring channels, then neighbouring k: they read and write whole rows of memory.


@triton.jit
@no_type_check
def directions(means, camera, i, k, valid):
    """Coordinates of the unit vectors from the camera to the means in the order of the functions of degree 1, y, z and
    x; where they stand in rows of `means`, which of them exist, and the distances to the camera."""
    at = 3 * i[:, None] + ((k + 1) % 3)[None, :]
    exists = valid[:, None] & (k < 3)[None, :]
    eye = tl.load(camera + 4 * ((k + 1) % 3) + 3)[None, :]
    offset = tl.where(exists, tl.load(means + at, mask=exists, other=0.0) - eye, 0.0)
    length = tl.maximum(tl.sqrt(tl.sum(offset * offset, 1)), 1e-12)
    return offset / length[:, None], at, exists, length


@triton.jit
@no_type_check
def signed(k):
    """The factors of y, z and x in the functions of degree 1."""
    return tl.where(k == 1, LINEAR, -LINEAR)[None, :]


@triton.jit
@no_type_check
def color_indices(i, k, channel, valid, OTHERS: tl.constexpr):
    """Where the colors of Gaussians i, and their coefficients of degree 1, stand in memory, and which of them exist."""
    color, known = 3 * i[:, None] + channel[None, :], valid[:, None] & (channel < 3)[None, :]
    linear = 3 * OTHERS * i[:, None, None] + 3 * k[None, :, None] + channel[None, None, :]
    return color, known, linear, known[:, None, :] & (k < 3)[None, :, None]


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colors(means, sh0, shN, camera, colors, count, OTHERS: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr):
    i, k, channel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, 4), tl.arange(0, 4)
    color, known, linear, exists = color_indices(i, k, channel, i < count, OTHERS)
    shown = CONSTANT * tl.load(sh0 + color, mask=known, other=0.0) + 0.5
    if DEGREE == 1:
        functions = signed(k) * directions(means, camera, i, k, i < count)[0]
        shown += tl.sum(functions[:, :, None] * tl.load(shN + linear, mask=exists, other=0.0), 1)
    tl.store(colors + color, tl.maximum(shown, 0.0), mask=known)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colors_backward(
    means, shN, camera, colors, v_colors, v_means, v_sh0, v_shN, count, stride,
    OTHERS: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i, k, channel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, 4), tl.arange(0, 4)
    color, known, linear, exists = color_indices(i, k, channel, i < count, OTHERS)
    v_color = tl.load(v_colors + stride * i[:, None] + channel[None, :], mask=known, other=0.0)
    v_color = tl.where(tl.load(colors + color, mask=known, other=0.0) > 0.0, v_color, 0.0)
    tl.store(v_sh0 + color, CONSTANT * v_color, mask=known)
    direction, at, inside, length = directions(means, camera, i, k, i < count)
    along = tl.zeros((BLOCK, 4), tl.float32)
    if DEGREE == 1:
        tl.store(v_shN + linear, (signed(k) * direction)[:, :, None] * v_color[:, None, :], mask=exists)
        along = signed(k) * tl.sum(v_color[:, None, :] * tl.load(shN + linear, mask=exists, other=0.0), 2)
    across = along - tl.sum(along * direction, 1)[:, None] * direction
    tl.store(v_means + at, across / length[:, None], mask=inside)
