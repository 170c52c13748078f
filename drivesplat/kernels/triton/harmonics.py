"""The colours in which a camera sees Gaussians, by harmonics up to degree 1, in one pass, and their gradient."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.spherical_harmonics import SH_C0
from drivesplat.kernels.triton.rows import store_three, three

BLOCK = 256
"""Gaussians a program."""
DEGREES = (0, 1)
"""Those that there are kernels for."""
CONSTANT, LINEAR = tl.constexpr(SH_C0), tl.constexpr(0.4886025119029199)
"""The factors of the functions of degree 0 and 1, in the order and with the signs of 3D Gaussian Splatting."""


def seen_colours(
    means: Float[Tensor, "n 3"],
    sh0: Float[Tensor, "n 1 3"],
    shN: Float[Tensor, "n k_less_1 3"],
    camera_to_world: Float[Tensor, "4 4"],
    degree: int,
) -> Float[Tensor, "n 3"]:
    """The harmonics up to `degree` (0 or 1) along the directions from the camera to `means`, plus 0.5, at least 0.
    There is no gradient for the camera."""
    return _SeenColours.apply(means, sh0, shN, camera_to_world, degree)


class _SeenColours(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, sh0: Tensor, shN: Tensor, camera_to_world: Tensor, degree: int) -> Tensor:
        means, sh0, shN, camera = (values.contiguous() for values in (means, sh0, shN, camera_to_world))
        count, others = shN.shape[:2]
        colours = means.new_empty(count, 3)
        if count:
            _colours[(triton.cdiv(count, BLOCK),)](means, sh0, shN, camera, colours, count, others, degree, BLOCK)
        ctx.save_for_backward(means, shN, camera, colours)
        ctx.degree = degree
        return colours

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colours: Tensor) -> tuple[Tensor | None, ...]:
        means, shN, camera, colours = ctx.saved_tensors
        count, others = shN.shape[:2]
        v_means, v_sh0 = torch.empty_like(means), means.new_empty(count, 1, 3)
        v_shN = torch.empty_like(shN) if ctx.degree == 1 and others == 3 else torch.zeros_like(shN)
        if count:
            _colours_back[(triton.cdiv(count, BLOCK),)](
                means, shN, camera, colours, v_colours.contiguous(), v_means, v_sh0, v_shN,
                count, others, ctx.degree, BLOCK,
            )  # fmt: skip
        return v_means, v_sh0, v_shN, None, None


@triton.jit
@no_type_check
def _direction(means, camera, i, there):
    """Unit vectors from the camera, and how long they were."""
    x, y, z = three(means, i, there)
    x, y, z = x - tl.load(camera + 3), y - tl.load(camera + 7), z - tl.load(camera + 11)
    length = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-12)
    return x / length, y / length, z / length, length


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colours(means, sh0, shN, camera, colours, count, OTHERS: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = i < count
    x, y, z, _ = _direction(means, camera, i, there)
    for channel in tl.static_range(3):
        colour = CONSTANT * tl.load(sh0 + 3 * i + channel, mask=there, other=0.0) + 0.5
        if DEGREE == 1:
            own = shN + 3 * OTHERS * i + channel
            by_y, by_z = tl.load(own, mask=there, other=0.0), tl.load(own + 3, mask=there, other=0.0)
            colour += LINEAR * (z * by_z - y * by_y - x * tl.load(own + 6, mask=there, other=0.0))
        tl.store(colours + 3 * i + channel, tl.maximum(colour, 0.0), mask=there)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colours_back(
    means, shN, camera, colours, v_colours, v_means, v_sh0, v_shN, count,
    OTHERS: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = i < count
    x, y, z, length = _direction(means, camera, i, there)
    along_x = tl.zeros((BLOCK,), tl.float32)
    along_y, along_z = along_x, along_x
    for channel in tl.static_range(3):
        pull = tl.load(v_colours + 3 * i + channel, mask=there, other=0.0)
        pull = tl.where(tl.load(colours + 3 * i + channel, mask=there, other=0.0) > 0.0, pull, 0.0)
        tl.store(v_sh0 + 3 * i + channel, CONSTANT * pull, mask=there)
        if DEGREE == 1:
            own, pull = 3 * OTHERS * i + channel, LINEAR * pull
            tl.store(v_shN + own, -y * pull, mask=there)
            tl.store(v_shN + own + 3, z * pull, mask=there)
            tl.store(v_shN + own + 6, -x * pull, mask=there)
            along_x -= pull * tl.load(shN + own + 6, mask=there, other=0.0)
            along_y -= pull * tl.load(shN + own, mask=there, other=0.0)
            along_z += pull * tl.load(shN + own + 3, mask=there, other=0.0)
    radial = along_x * x + along_y * y + along_z * z
    across_x, across_y, across_z = along_x - radial * x, along_y - radial * y, along_z - radial * z
    store_three(v_means, i, across_x / length, across_y / length, across_z / length, there)
