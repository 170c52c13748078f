"""The depth of the surfaces that images show, a tile per program (`drivesplat.kernels.surface_depth`)."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.triton.tiles import MIN_ALPHA, TILE, Footprints, TileLists

MAX_ALPHA, MIN_TRANSMITTANCE, NEAR_PLANE = tl.constexpr(0.999), tl.constexpr(1e-4), tl.constexpr(0.01)


def surface_depth(gaussians: Footprints, lists: TileLists, alpha: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    """The depth in metres at which rays have passed half of `alpha`; 0 where they meet nothing. The values of
    `gaussians` are their depth planes."""
    given = [values.contiguous() for values in (*gaussians, alpha)]
    (cameras, down, across), (height, width) = lists.tiles, alpha.shape[1:]
    found = torch.zeros_like(alpha)
    _surface_depths[(cameras * down * across,)](
        *given, lists.ids, lists.order, lists.offsets, found, width, height, across, down * across
    )
    return found


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _surface_depths(
    means, conics, planes, opacities, alpha, ids, order, offsets, found, width, height, across, per_camera
):
    """Writes the depths of a tile."""
    tile = tl.program_id(0)
    camera, within = tile // per_camera, tile % per_camera
    pixel = tl.arange(0, TILE * TILE)
    x, y = within % across * TILE + pixel % TILE, within // across * TILE + pixel // TILE
    to, inside = (camera.to(tl.int64) * height + y) * width + x, (x < width) & (y < height)
    half = 0.5 * tl.load(alpha + to, mask=inside, other=0.0)
    depth, passed = tl.zeros((TILE * TILE,), tl.float32), tl.zeros((TILE * TILE,), tl.float32)
    left = tl.zeros((TILE * TILE,), tl.float32) + 1.0
    for entry in range(tl.load(offsets + tile), tl.load(offsets + tile + 1)):
        i = tl.load(ids + tl.load(order + entry)).to(tl.int64)
        weight, left, over_x, over_y = _weigh(means, conics, opacities, i, x, y, left)
        at = tl.load(planes + 3 * i) + tl.load(planes + 3 * i + 1) * over_x + tl.load(planes + 3 * i + 2) * over_y
        reached = (passed < half) & (passed + weight >= half)
        depth = tl.where(reached, tl.maximum(at, NEAR_PLANE), depth)
        passed += weight
    tl.store(found + to, depth, mask=inside)


@triton.jit
@no_type_check
def _weigh(means, conics, opacities, i, x, y, left):
    """The weights of Gaussian i at pixels x, y of transmittances `left`, those behind it (0 where rays end), and the
    pixels' offsets from its centre."""
    over_x = x.to(tl.float32) + 0.5 - tl.load(means + 2 * i)
    over_y = y.to(tl.float32) + 0.5 - tl.load(means + 2 * i + 1)
    a, b, c = tl.load(conics + 3 * i), tl.load(conics + 3 * i + 1), tl.load(conics + 3 * i + 2)
    fall = 0.5 * (a * over_x * over_x + c * over_y * over_y) + b * over_x * over_y
    alpha = tl.minimum(tl.load(opacities + i) * tl.exp(-fall), MAX_ALPHA)
    alpha = tl.where((fall < 0.0) | (alpha < MIN_ALPHA), 0.0, alpha)
    behind = left * (1.0 - alpha)
    seen = behind > MIN_TRANSMITTANCE
    return tl.where(seen, alpha * left, 0.0), tl.where(seen, behind, 0.0), over_x, over_y
