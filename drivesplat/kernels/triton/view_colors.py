"""The colors that one camera sees of Gaussians, by harmonics up to degree 1, in one pass, and their gradient."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.spherical_harmonics import SH_C0
from drivesplat.kernels.triton.rows import store_three, three

BLOCK = 256
"""Gaussians per program."""
CONSTANT, LINEAR = tl.constexpr(SH_C0), tl.constexpr(0.4886025119029199)
"""The factors of the functions of degree 0 and 1, in the order and with the signs of 3D Gaussian Splatting."""


class ViewColors(torch.autograd.Function):
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
        if count:
            _colors_backward[(triton.cdiv(count, BLOCK),)](
                means, shN, camera, colors, v_colors.contiguous(), v_means, v_sh0, v_shN,
                count, others, ctx.degree, BLOCK,
            )  # fmt: skip
        return v_means, v_sh0, v_shN, None, None


@triton.jit
@no_type_check
def _direction(means, camera, i, valid):
    """Unit vectors from the camera to the means, and their distances."""
    x, y, z = three(means, i, valid)
    x, y, z = x - tl.load(camera + 3), y - tl.load(camera + 7), z - tl.load(camera + 11)
    length = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-12)
    return x / length, y / length, z / length, length


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colors(means, sh0, shN, camera, colors, count, OTHERS: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    x, y, z, _ = _direction(means, camera, i, valid)
    for channel in tl.static_range(3):
        color = CONSTANT * tl.load(sh0 + 3 * i + channel, mask=valid, other=0.0) + 0.5
        if DEGREE == 1:
            own = shN + 3 * OTHERS * i + channel
            by_y, by_z = tl.load(own, mask=valid, other=0.0), tl.load(own + 3, mask=valid, other=0.0)
            color += LINEAR * (z * by_z - y * by_y - x * tl.load(own + 6, mask=valid, other=0.0))
        tl.store(colors + 3 * i + channel, tl.maximum(color, 0.0), mask=valid)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colors_backward(
    means, shN, camera, colors, v_colors, v_means, v_sh0, v_shN, count,
    OTHERS: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    x, y, z, length = _direction(means, camera, i, valid)
    along_x = tl.zeros((BLOCK,), tl.float32)
    along_y, along_z = along_x, along_x
    for channel in tl.static_range(3):
        v_color = tl.load(v_colors + 3 * i + channel, mask=valid, other=0.0)
        v_color = tl.where(tl.load(colors + 3 * i + channel, mask=valid, other=0.0) > 0.0, v_color, 0.0)
        tl.store(v_sh0 + 3 * i + channel, CONSTANT * v_color, mask=valid)
        if DEGREE == 1:
            own, v_linear = 3 * OTHERS * i + channel, LINEAR * v_color
            tl.store(v_shN + own, -y * v_linear, mask=valid)
            tl.store(v_shN + own + 3, z * v_linear, mask=valid)
            tl.store(v_shN + own + 6, -x * v_linear, mask=valid)
            along_x -= v_linear * tl.load(shN + own + 6, mask=valid, other=0.0)
            along_y -= v_linear * tl.load(shN + own, mask=valid, other=0.0)
            along_z += v_linear * tl.load(shN + own + 3, mask=valid, other=0.0)
    radial = along_x * x + along_y * y + along_z * z
    across_x, across_y, across_z = along_x - radial * x, along_y - radial * y, along_z - radial * z
    store_three(v_means, i, across_x / length, across_y / length, across_z / length, valid)
