"""What Gaussians send back to a LiDAR in one pass, and the gradient of their logits in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.rows import three
from drivesplat.kernels.triton.vectors import dot, scaled

BLOCK = 256
"""Gaussians per program."""


class LidarResponse(torch.autograd.Function):
    """`drivesplat.kernels.view_colors.lidar_response`. Gradients reach the logits."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor, means: Tensor, sensor: Tensor) -> Tensor:
        means, sensor, count = means.contiguous(), sensor.contiguous(), len(means)
        values = logits.new_empty(count, 2)
        if count:
            _values[(triton.cdiv(count, BLOCK),)](logits.contiguous(), means, sensor, values, count, BLOCK)
        ctx.save_for_backward(means, sensor, values)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_values: Tensor) -> tuple[Tensor, None, None]:
        means, sensor, values = ctx.saved_tensors
        count = len(means)
        v_logits = values.new_empty(count, 4, 2)
        if count:
            grid = (triton.cdiv(count, BLOCK),)
            _values_backward[grid](means, sensor, values, v_values.contiguous(), v_logits, count, BLOCK)
        return v_logits, None, None


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _values(logits, means, sensor, measured, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid, entry = i < count, tl.arange(0, 8)[None, :]
    factors = _factors(means, sensor, i, valid, entry)
    products = factors * tl.load(logits + 8 * i[:, None] + entry, mask=valid[:, None], other=0.0)
    for channel in tl.static_range(2):
        logit = tl.sum(tl.where(entry % 2 == channel, products, 0.0), 1)
        tl.store(measured + 2 * i + channel, tl.sigmoid(logit), mask=valid)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _values_backward(means, sensor, measured, v_measured, v_logits, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid, entry = i < count, tl.arange(0, 8)[None, :]
    own = 2 * i[:, None] + entry % 2
    value = tl.load(measured + own, mask=valid[:, None], other=0.0)
    given = tl.load(v_measured + own, mask=valid[:, None], other=0.0) * value * (1.0 - value)
    tl.store(v_logits + 8 * i[:, None] + entry, given * _factors(means, sensor, i, valid, entry), mask=valid[:, None])


@triton.jit
@no_type_check
def _factors(means, sensor, i, valid, entry):
    """The factors of the 4 x 2 coefficients of Gaussian i, a row each, in its two logits: 1 and the unit vector from
    the sensor. A row of them is read and written at once."""
    x, y, z = three(means, i, valid)
    toward = x - tl.load(sensor), y - tl.load(sensor + 1), z - tl.load(sensor + 2)
    x, y, z = scaled(1.0 / tl.maximum(tl.sqrt(dot(toward, toward)), 1e-12), toward)
    rest = tl.where(entry // 2 == 2, y[:, None], z[:, None])
    return tl.where(entry // 2 == 0, 1.0, tl.where(entry // 2 == 1, x[:, None], rest))
