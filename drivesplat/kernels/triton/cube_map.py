"""An image over a cube map in one pass, and its gradient in another: rays, faces, texels and blending."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK = 256
"""Pixels per program."""
MIN_TRANSMITTANCE = tl.constexpr(1e-3)
"""Minimum transmittance for gradients of texels: every opaque surface lets a trace of the background through."""
RUN = tl.constexpr(4)
"""Neighbouring pixels that mostly see the same texels."""


class TritonOverCubeMap(torch.autograd.Function):
    """`drivesplat.kernels.cube_map.over_cube_map`, without gradient for the camera."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, alpha: Tensor, texels: Tensor, index: Tensor, K: Tensor, camera_to_world: Tensor,
        turning: Tensor | None,
    ) -> Tensor:  # fmt: skip
        camera = K.contiguous(), camera_to_world.contiguous(), K if turning is None else turning.contiguous()
        image, alpha = image.contiguous(), alpha.contiguous()
        blended = torch.empty_like(image)
        pixels = alpha.numel()
        _blend[(triton.cdiv(pixels, BLOCK),)](
            image, alpha, texels, index, *camera, blended, pixels, image.shape[1], index.shape[1],
            turning is not None, BLOCK,
        )  # fmt: skip
        ctx.save_for_backward(alpha, texels, index, *camera)
        ctx.turns = turning is not None
        return blended

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor) -> tuple[Tensor | None, ...]:
        alpha, texels, index, *camera = ctx.saved_tensors
        v_image = v_image.contiguous()
        v_alpha, v_texels = torch.empty_like(alpha), torch.zeros_like(texels)
        pixels = alpha.numel()
        _gradients[(triton.cdiv(pixels, BLOCK),)](
            v_image, alpha, texels, index, *camera, v_alpha, v_texels, pixels, v_image.shape[1], index.shape[1],
            ctx.turns, BLOCK,
        )  # fmt: skip
        return v_image, v_alpha, v_texels, None, None, None, None


@triton.jit
@no_type_check
def _ray(K, camera_to_world, turning, pixel, width, TURNS: tl.constexpr):
    """World directions of the pixels' centres, not normalized."""
    column, row = (pixel % width).to(tl.float32) + 0.5, (pixel // width).to(tl.float32) + 0.5
    x, y = (column - tl.load(K + 2)) / tl.load(K), (row - tl.load(K + 5)) / tl.load(K + 4)
    z = 0.0 * x + 1.0
    if TURNS:
        seconds = tl.load(turning) * column + tl.load(turning + 1) * row + tl.load(turning + 2)
        by_x, by_y, by_z = tl.load(turning + 3), tl.load(turning + 4), tl.load(turning + 5)
        x, y, z = (
            x + seconds * (by_y - by_z * y),
            y + seconds * (by_z * x - by_x),
            z + seconds * (by_x * y - by_y * x),
        )
    pose = camera_to_world
    ray_x = tl.load(pose) * x + tl.load(pose + 1) * y + tl.load(pose + 2) * z
    ray_y = tl.load(pose + 4) * x + tl.load(pose + 5) * y + tl.load(pose + 6) * z
    ray_z = tl.load(pose + 8) * x + tl.load(pose + 9) * y + tl.load(pose + 10) * z
    return ray_x, ray_y, ray_z


@triton.jit
@no_type_check
def _corners(index, K, camera_to_world, turning, pixel, width, resolution, inside, TURNS: tl.constexpr):
    """The four texels around the points that pixels see, and the offsets from the first one along both edges of the
    face."""
    ray_x, ray_y, ray_z = _ray(K, camera_to_world, turning, pixel, width, TURNS)
    far_x, far_y, far_z = tl.abs(ray_x), tl.abs(ray_y), tl.abs(ray_z)
    on_x = (far_x >= far_y) & (far_x >= far_z)
    on_y = (far_y > far_x) & (far_y >= far_z)
    along = tl.where(on_x, ray_x, tl.where(on_y, ray_y, ray_z))
    u = tl.where(on_x, ray_y, tl.where(on_y, ray_z, ray_x)) / tl.abs(along)
    v = tl.where(on_x, ray_z, tl.where(on_y, ray_x, ray_y)) / tl.abs(along)
    face = tl.where(on_x, 0, tl.where(on_y, 2, 4)) + tl.where(along < 0, 1, 0)
    last = resolution - 1
    at_u = tl.minimum(tl.maximum((u + 1.0) * 0.5 * last, 0.0), last)
    at_v = tl.minimum(tl.maximum((v + 1.0) * 0.5 * last, 0.0), last)
    low_u, low_v = at_u.to(tl.int32), at_v.to(tl.int32)
    high_u, high_v = tl.minimum(low_u + 1, last), tl.minimum(low_v + 1, last)
    low, high = (face * resolution + low_v) * resolution, (face * resolution + high_v) * resolution
    texel_00 = tl.load(index + low + low_u, mask=inside, other=0)
    texel_01 = tl.load(index + low + high_u, mask=inside, other=0)
    texel_10 = tl.load(index + high + low_u, mask=inside, other=0)
    texel_11 = tl.load(index + high + high_u, mask=inside, other=0)
    return texel_00, texel_01, texel_10, texel_11, at_u - low_u, at_v - low_v


@triton.jit
@no_type_check
def _color(texels, channel, texel_00, texel_01, texel_10, texel_11, part_u, part_v, inside):
    """One channel of the cube map's color, interpolated."""
    above = (1.0 - part_u) * tl.load(texels + 3 * texel_00 + channel, mask=inside, other=0.0)
    above += part_u * tl.load(texels + 3 * texel_01 + channel, mask=inside, other=0.0)
    below = (1.0 - part_u) * tl.load(texels + 3 * texel_10 + channel, mask=inside, other=0.0)
    below += part_u * tl.load(texels + 3 * texel_11 + channel, mask=inside, other=0.0)
    return tl.sigmoid((1.0 - part_v) * above + part_v * below)


@triton.jit(do_not_specialize=["pixels", "width"])
@no_type_check
def _blend(
    image, alpha, texels, index, K, camera_to_world, turning, blended, pixels, width, resolution,
    TURNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    a, b, c, d, part_u, part_v = _corners(index, K, camera_to_world, turning, pixel, width, resolution, inside, TURNS)
    left = 1.0 - tl.load(alpha + pixel, mask=inside, other=1.0)
    for channel in tl.static_range(3):
        sky = _color(texels, channel, a, b, c, d, part_u, part_v, inside)
        front = tl.load(image + 3 * pixel + channel, mask=inside, other=0.0)
        tl.store(blended + 3 * pixel + channel, front + left * sky, mask=inside)


@triton.jit
@no_type_check
def _alike(texel, BLOCK: tl.constexpr):
    """The runs of pixels that all see the same texel."""
    runs = tl.reshape(texel, (BLOCK // RUN, RUN))
    return tl.max(runs, 1) == tl.min(runs, 1)


@triton.jit
@no_type_check
def _add(place, value, visible, alike, BLOCK: tl.constexpr):
    """Adds values to their texels' gradients, one sum for each run that sees the same texel: fewer atomic additions to
    one place."""
    value = tl.where(visible, value, 0.0)
    together = tl.sum(tl.reshape(value, (BLOCK // RUN, RUN)), 1)
    first = tl.min(tl.reshape(place.to(tl.int64), (BLOCK // RUN, RUN)), 1).to(place.dtype)
    tl.atomic_add(first, together, mask=alike & (together != 0.0), sem="relaxed")
    alone = tl.reshape(tl.broadcast_to(alike[:, None], (BLOCK // RUN, RUN)), (BLOCK,)) == 0
    tl.atomic_add(place, value, mask=alone & (value != 0.0), sem="relaxed")


@triton.jit(do_not_specialize=["pixels", "width"])
@no_type_check
def _gradients(
    v_image, alpha, texels, index, K, camera_to_world, turning, v_alpha, v_texels, pixels, width, resolution,
    TURNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The gradients of alpha, and the sums of those of texels."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    a, b, c, d, part_u, part_v = _corners(index, K, camera_to_world, turning, pixel, width, resolution, inside, TURNS)
    left = 1.0 - tl.load(alpha + pixel, mask=inside, other=1.0)
    hidden = tl.zeros((BLOCK,), tl.float32)
    visible = inside & (left > MIN_TRANSMITTANCE)
    alike = _alike(a, BLOCK) & _alike(b, BLOCK) & _alike(c, BLOCK) & _alike(d, BLOCK)
    for channel in tl.static_range(3):
        sky = _color(texels, channel, a, b, c, d, part_u, part_v, inside)
        by_pixel = tl.load(v_image + 3 * pixel + channel, mask=inside, other=0.0)
        hidden += by_pixel * sky
        by_logit = by_pixel * left * sky * (1.0 - sky)
        _add(v_texels + 3 * a + channel, by_logit * (1.0 - part_u) * (1.0 - part_v), visible, alike, BLOCK)
        _add(v_texels + 3 * b + channel, by_logit * part_u * (1.0 - part_v), visible, alike, BLOCK)
        _add(v_texels + 3 * c + channel, by_logit * (1.0 - part_u) * part_v, visible, alike, BLOCK)
        _add(v_texels + 3 * d + channel, by_logit * part_u * part_v, visible, alike, BLOCK)
    tl.store(v_alpha + pixel, -hidden, mask=inside)
