"""Gaussians projected into one camera, with their colors, in one pass over each set, and the gradient in another.

The projection is that of `drivesplat.kernels.numba.projection`, in the terms of `drivesplat.kernels.triton.pinhole`.
The gradients of the determinant |p × q|² are 2 q × (p × q) for p and 2 (p × q) × p for q.
"""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.pinhole import EPS2D, axes_in_camera, covariance, in_camera, in_image, rotation
from drivesplat.kernels.triton.rows import store_quaternion, store_three, store_two, three, two, unit
from drivesplat.kernels.triton.tiles import MIN_ALPHA
from drivesplat.kernels.triton.vectors import (
    added,
    axes_gradient,
    cross,
    dot,
    scaled,
    turned_back,
)
from drivesplat.kernels.triton.view_colors import CONSTANT, color_indices, directions, signed

BLOCK = 128
"""Gaussians per program."""
TENSORS = 6
"""Tensors of a set: means, quaternions, scales, opacities, and harmonics of degree 0 and above."""
NEAR_PLANE, FAR_PLANE = tl.constexpr(0.01), tl.constexpr(1e10)
EXTENT = tl.constexpr(3.33)
"""Largest radius in standard deviations, as in gsplat."""


class ColoredProjection(torch.autograd.Function):
    """`drivesplat.kernels.colored_projection.project_with_colors`: means2d (1, n, 2), depths (1, n), conics (1, n, 3),
    radii (1, n, 2), opacities (1, n) and values (1, n, 3 or 4). `sets` holds TENSORS tensors of each set, `degrees` the
    degree up to which harmonics of each are evaluated. Gradients reach all of `sets`."""

    @staticmethod
    def forward(
        ctx: Any, viewmat: Tensor, K: Tensor, camera_to_world: Tensor, size: tuple[int, int], degrees: tuple[int, ...],
        with_depth: bool, *sets: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        camera = tuple(values.contiguous() for values in (viewmat, K, camera_to_world))
        given = tuple(values.contiguous() for values in sets)
        count, new = sum(len(means) for means in given[::TENSORS]), viewmat.new_empty
        means2d, depths, conics, opacities = (new(1, count, *tail) for tail in ((2,), (), (3,), ()))
        radii = torch.empty(1, count, 2, dtype=torch.int32, device=viewmat.device)
        values, first = new(1, count, 3 + with_depth), 0
        for own, degree in zip(_by_set(given), degrees, strict=True):
            programs = triton.cdiv(len(own[0]), BLOCK)
            if programs:
                _project[(programs,)](
                    *own, *camera, means2d, depths, conics, radii, opacities, values, len(own[0]), first, *size,
                    own[5].shape[1], degree, with_depth, BLOCK,
                )  # fmt: skip
            first += len(own[0])
        ctx.save_for_backward(*camera, radii, values, *given)
        ctx.options = (size, degrees, with_depth)
        ctx.mark_non_differentiable(depths, radii)
        return means2d, depths, conics, radii, opacities, values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (*camera, radii, values), sets = ctx.saved_tensors[:5], ctx.saved_tensors[5:]
        size, degrees, with_depth = ctx.options
        v_means2d, _, v_conics, _, *others = (gradient.contiguous() for gradient in gradients)
        found: list[Tensor] = []
        first = 0
        for own, degree in zip(_by_set(sets), degrees, strict=True):
            programs, above = triton.cdiv(len(own[0]), BLOCK), own[5].shape[1]
            v_own = [torch.empty_like(tensor) for tensor in own[:5]]
            v_own.append(torch.empty_like(own[5]) if above == 3 * degree else torch.zeros_like(own[5]))
            if programs:
                _project_backward[(programs,)](
                    *own, *camera, radii, values, v_means2d, v_conics, *others, *v_own, len(own[0]), first,
                    *size, above, degree, with_depth, BLOCK,
                )  # fmt: skip
            found, first = found + v_own, first + len(own[0])
        return None, None, None, None, None, None, *found


def _by_set(tensors: tuple[Tensor, ...]) -> list[tuple[Tensor, ...]]:
    return [tensors[at : at + TENSORS] for at in range(0, len(tensors), TENSORS)]


@triton.jit(do_not_specialize=["count", "first", "width", "height"])
@no_type_check
def _project(
    means, quats, scales, opacities, sh0, shN, viewmat, K, camera_to_world, means2d, depths, conics, radii, opacities2d,
    values, count, first, width, height,
    OTHERS: tl.constexpr, DEGREE: tl.constexpr, DEPTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the rows of one set, from row `first` on; for Gaussians out of view only the opacity and a radius of
    0."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid, row = i < count, first + i
    opacity, size = tl.load(opacities + i, mask=valid, other=0.0), three(scales, i, valid)
    tl.store(opacities2d + row, opacity, mask=valid)

    at = in_camera(three(means, i, valid), viewmat)
    z = at[2]
    seen = valid & (z >= NEAR_PLANE) & (z <= FAR_PLANE) & (opacity >= MIN_ALPHA)
    at = at[0], at[1], tl.where(seen, z, 1.0)
    w, x, y, z_, _ = unit(quats, i, seen)
    p, q, _, _, _, _ = in_image(axes_in_camera((w, x, y, z_), size, viewmat), at, K, width, height)
    xx, xy, yy, determinant, _ = covariance(p, q)
    u = tl.load(K) * at[0] / at[2] + tl.load(K + 2)
    v = tl.load(K + 4) * at[1] / at[2] + tl.load(K + 5)
    extent = tl.minimum(EXTENT, tl.sqrt(2.0 * tl.log(tl.maximum(opacity / MIN_ALPHA, 1.0))))
    wide, high = tl.ceil(extent * tl.sqrt(xx)), tl.ceil(extent * tl.sqrt(yy))
    seen = seen & (u + wide > 0.0) & (u - wide < width) & (v + high > 0.0) & (v - high < height)
    seen = seen & ((wide > 0.0) | (high > 0.0))
    store_two(radii, row, tl.where(seen, wide, 0.0).to(tl.int32), tl.where(seen, high, 0.0).to(tl.int32), valid)
    store_two(means2d, row, u, v, seen)
    tl.store(depths + row, z, mask=seen)
    store_three(conics, row, yy / determinant, -xy / determinant, xx / determinant, seen)

    k, channel = tl.arange(0, 4), tl.arange(0, 4)
    color, known, linear, exists = color_indices(i, k, channel, seen, OTHERS)
    shown = CONSTANT * tl.load(sh0 + color, mask=known, other=0.0) + 0.5
    if DEGREE == 1:
        functions = signed(k) * directions(means, camera_to_world, i, k, seen)[0]
        shown += tl.sum(functions[:, :, None] * tl.load(shN + linear, mask=exists, other=0.0), 1)
    shown = tl.maximum(shown, 0.0)
    if DEPTH:
        shown = tl.where((channel == 3)[None, :], z[:, None], shown)
    place = (3 + DEPTH) * row[:, None] + channel[None, :]
    tl.store(values + place, shown, mask=seen[:, None] & (channel < 3 + DEPTH)[None, :])


@triton.jit(do_not_specialize=["count", "first", "width", "height"])
@no_type_check
def _project_backward(
    means, quats, scales, opacities, sh0, shN, viewmat, K, camera_to_world, radii, values, v_means2d, v_conics,
    v_opacities2d, v_values, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN, count, first, width, height,
    OTHERS: tl.constexpr, DEGREE: tl.constexpr, DEPTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the gradients of one set, whose first row is `first`."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid, row = i < count, first + i
    tl.store(v_opacities + i, tl.load(v_opacities2d + row, mask=valid, other=0.0), mask=valid)
    wide, high = two(radii, row, valid)
    seen = (wide > 0) & (high > 0)

    k, channel = tl.arange(0, 4), tl.arange(0, 4)
    color, known, linear, exists = color_indices(i, k, channel, seen, OTHERS)
    _, written, _, written_above = color_indices(i, k, channel, valid, OTHERS)
    at_value = (3 + DEPTH) * row[:, None] + channel[None, :]
    v_color = tl.load(v_values + at_value, mask=known, other=0.0)
    v_color = tl.where(tl.load(values + at_value, mask=known, other=0.0) > 0.0, v_color, 0.0)
    tl.store(v_sh0 + color, CONSTANT * v_color, mask=written)
    direction, place, _, distance = directions(means, camera_to_world, i, k, seen)
    along = tl.zeros((BLOCK, 4), tl.float32)
    if DEGREE == 1:
        functions = signed(k) * direction
        tl.store(v_shN + linear, functions[:, :, None] * v_color[:, None, :], mask=written_above)
        along = signed(k) * tl.sum(v_color[:, None, :] * tl.load(shN + linear, mask=exists, other=0.0), 2)
    by_color = (along - tl.sum(along * direction, 1)[:, None] * direction) / distance[:, None]

    at = in_camera(three(means, i, seen), viewmat)
    at = at[0], at[1], tl.where(seen, at[2], 1.0)
    w, x, y, z, length = unit(quats, i, seen)
    size = three(scales, i, seen)
    axes = axes_in_camera((w, x, y, z), size, viewmat)
    p, q, across, within_x, down, within_y = in_image(axes, at, K, width, height)
    xx, xy, yy, determinant, normal = covariance(p, q)
    by_conic = three(v_conics, row, seen)
    by_yy, by_xy, by_xx = by_conic[0] / determinant, -by_conic[1] / determinant, by_conic[2] / determinant
    by_determinant = -(by_yy * yy + by_xy * xy + by_xx * xx) / determinant
    by_xx, by_yy = by_xx + EPS2D * by_determinant, by_yy + EPS2D * by_determinant
    by_p = added(scaled(2.0 * by_xx, p), scaled(by_xy, q))
    by_q = added(scaled(2.0 * by_yy, q), scaled(by_xy, p))
    by_p = added(by_p, scaled(2.0 * by_determinant, cross(q, normal)))
    by_q = added(by_q, scaled(2.0 * by_determinant, cross(normal, p)))
    fx, fy = tl.load(K), tl.load(K + 4)
    near_x, near_y = fx / at[2], fy / at[2]
    by_axes = (
        scaled(near_x, by_p),
        scaled(near_y, by_q),
        added(scaled(-near_x * across, by_p), scaled(-near_y * down, by_q)),
    )
    by_u, by_v = two(v_means2d, row, seen)
    by_across = fx * by_u - tl.where(within_x, near_x * dot(by_p, axes[2]), 0.0)
    by_down = fy * by_v - tl.where(within_y, near_y * dot(by_q, axes[2]), 0.0)
    by_z = -(by_across * at[0] / at[2] + by_down * at[1] / at[2] + dot(by_p, p) + dot(by_q, q)) / at[2]
    if DEPTH:
        by_z += tl.load(v_values + 4 * row + 3, mask=seen, other=0.0)
    to_camera = rotation(viewmat)
    by_mean = turned_back(to_camera, (by_across / at[2], by_down / at[2], by_z))
    axis = ((k + 1) % 3)[None, :]  # as `directions`: y, z and x
    by_place = tl.where(axis == 0, by_mean[0][:, None], tl.where(axis == 1, by_mean[1][:, None], by_mean[2][:, None]))
    tl.store(v_means + place, tl.where(seen[:, None], by_color + by_place, 0.0), mask=valid[:, None] & (k < 3)[None, :])

    by_rows = (
        turned_back(by_axes, (to_camera[0][0], to_camera[1][0], to_camera[2][0])),
        turned_back(by_axes, (to_camera[0][1], to_camera[1][1], to_camera[2][1])),
        turned_back(by_axes, (to_camera[0][2], to_camera[1][2], to_camera[2][2])),
    )
    by_size, by_quat = axes_gradient(by_rows, size, w, x, y, z, length)
    store_three(
        v_scales, i, tl.where(seen, by_size[0], 0.0), tl.where(seen, by_size[1], 0.0), tl.where(seen, by_size[2], 0.0),
        valid,
    )  # fmt: skip
    store_quaternion(
        v_quats, i, tl.where(seen, by_quat[0], 0.0), tl.where(seen, by_quat[1], 0.0), tl.where(seen, by_quat[2], 0.0),
        tl.where(seen, by_quat[3], 0.0), valid,
    )  # fmt: skip
