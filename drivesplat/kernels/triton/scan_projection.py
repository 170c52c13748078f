"""Spherical projection of Gaussians into a LiDAR scan in one pass, and the gradient in another.

As `drivesplat.kernels.scan_projection`, whose formulas these are. With M the product of the rotations from world to
sensor and of the sensor's turn until a Gaussian is met, the axes of a Gaussian in the sensor's frame are M R S; their
rows x, y and z give the rows a, e and d of azimuth, elevation and range. The gradient of a cross product p x q is
q x g for p and g x p for q.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.scanned_gaussians import FIRING_STEPS, LEARNED, MAX_DEVIATIONS, MIN_ALPHA, PROJECTED, Revolution
from drivesplat.kernels.triton.rows import ALIGNED, store_quaternion, store_three, three, two, unit
from drivesplat.kernels.triton.scan_geometry import (
    at_timestamp,
    determinant_of,
    footprint_backward,
    met,
    offsets_at,
    spherical,
    spherical_backward,
    turn_of,
)
from drivesplat.kernels.triton.vectors import (
    added,
    atan2,
    axes_gradient,
    cross,
    dot,
    scaled,
    turned_back,
)

BLOCK = 128
"""Gaussians per program."""
FAINTEST, DEVIATIONS = tl.constexpr(MIN_ALPHA), tl.constexpr(MAX_DEVIATIONS)


class SensorMotion(NamedTuple):
    """What `ScanProjection` needs to know of the parts of a revolution, as tensors: `view`, the rows of the rotation
    from world to sensor, the translation (metres), and the sensor's velocity and angular velocity in its own frame
    (m/s, rad/s); `velocities` of the Gaussians in the world (m/s), or an empty tensor; `middles`, the azimuths between
    the firings of each part, one part after the other; the `offsets_s` of the firing before and after each; and how
    many `middles` each part has."""

    view: Float[Tensor, "18"]
    velocities: Float[Tensor, " v"]
    middles: Float[Tensor, " f"]
    offsets_s: Float[Tensor, " g"]
    counts: tuple[int, ...]


def sensor_motion(world_to_sensor: Float[Tensor, "4 4"], revolutions: Sequence[Revolution] | None) -> SensorMotion:
    """The motion during the parts of a revolution, one or two, which differ in their firings; None: rays share one
    time."""
    pose = [world_to_sensor[:3, :3].flatten(), world_to_sensor[:3, 3]]
    if revolutions is None:
        view, nothing = torch.cat([*pose, world_to_sensor.new_zeros(6)]), world_to_sensor.new_empty(0)
        return SensorMotion(view, nothing, nothing, nothing, (0,))
    first = revolutions[0]
    view, velocities = torch.cat([*pose, first.linear, first.angular]), first.velocities
    velocities = view.new_empty(0) if velocities is None else velocities.flatten()
    middles, offsets_s = (torch.cat(values) for values in zip(*(it.firings for it in revolutions), strict=True))
    return SensorMotion(view, velocities, middles, offsets_s, tuple(len(it.firings.between) for it in revolutions))


class ScanProjection(torch.autograd.Function):
    """The first six fields of `drivesplat.kernels.scan_projection.ScannedGaussians` for each part of a revolution.
    Gradients reach means, quats and scales: the kernel sums those of the parts."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, motion: SensorMotion,
        beam_spread: tuple[float, float], max_range: float,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        gaussians = tuple(values.contiguous() for values in (means, quats, scales))
        count, parts, sizes = len(means), len(motion.counts), (*PROJECTED, ())
        room = triton.cdiv(count, ALIGNED) * ALIGNED
        *projected, offsets = (means.new_empty(parts, room, *size) for size in sizes)
        ctx.options = (*beam_spread, max_range)
        if count:
            _project[(triton.cdiv(count, BLOCK),)](
                *gaussians, opacities.contiguous(), *motion[:4], *projected, offsets, motion.counts[0],
                motion.counts[-1], (max(motion.counts) + 1).bit_length(), *ctx.options, count, room,
                len(motion.middles) > 0, len(motion.velocities) > 0, FIRING_STEPS, parts, BLOCK,
            )  # fmt: skip
        ctx.motion = motion
        ctx.save_for_backward(*gaussians, offsets)
        by_part = [tuple(values[part, :count] for values in projected) for part in range(parts)]
        ctx.mark_non_differentiable(*(values for found in by_part for values in found[4:]))
        ctx.set_materialize_grads(False)  # zeros for `range_limits` and `radii`
        return tuple(values for found in by_part for values in found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        *gaussians, offsets = ctx.saved_tensors
        v_gaussians = tuple(torch.empty_like(values) for values in gaussians)
        count, (parts, room), motion = len(gaussians[0]), offsets.shape, ctx.motion
        first, last = (_given(ctx, gradients[at : at + 4]) for at in (0, 6 * (parts - 1)))
        if count:
            _project_backward[(triton.cdiv(count, BLOCK),)](
                *gaussians, offsets, motion.view, motion.velocities, *first, *last, *v_gaussians, *ctx.options, count,
                room, len(motion.middles) > 0, len(motion.velocities) > 0, parts, BLOCK,
            )  # fmt: skip
        return *v_gaussians, None, None, None, None


def _given(ctx: Any, gradients: Sequence[Tensor | None]) -> list[Tensor]:
    """The gradients of a part's means, ranges, conics and slopes; zeros where there are none."""
    means, *_ = ctx.saved_tensors
    found = zip(gradients, LEARNED, strict=True)
    return [means.new_zeros(len(means), *size) if values is None else values.contiguous() for values, size in found]


@triton.jit(
    do_not_specialize=["first_count", "last_count", "steps", "spread_a", "spread_e", "max_range", "count", "room"]
)
@no_type_check
def _project(
    means, quats, scales, opacities, view, velocities, middles, offsets_s, means2d, ranges, conics, slopes, limits,
    radii, offsets, first_count, last_count, steps, spread_a, spread_e, max_range, count, room,
    WITH_MOTION: tl.constexpr, MOVING: tl.constexpr, STEPS: tl.constexpr, PARTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Projects Gaussians for one or two parts of a revolution, which have `first_count` and `last_count` middles."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    opacity = tl.load(opacities + i, mask=valid, other=0.0)
    reach = tl.sqrt(2.0 * tl.log(tl.maximum(opacity / FAINTEST, 1.0)))
    for part in tl.static_range(PARTS):
        firings = first_count if part == 0 else last_count
        offset = tl.zeros((BLOCK,), tl.float32)
        if WITH_MOTION:
            center, velocity = at_timestamp(means, velocities, view, i, valid, MOVING)
            own, times_s = middles + part * first_count, offsets_s + part * (first_count + 1)
            for _ in range(STEPS):
                turn, moved = turn_of(view, offset), added(center, scaled(offset, velocity))
                offset = offsets_at(atan2(dot(turn[1], moved), dot(turn[0], moved)), own, times_s, firings, steps)
        place = part * room.to(tl.int64) + i
        tl.store(offsets + place, offset, mask=valid)
        center, seen, axes, _, _ = met(
            means, quats, scales, view, velocities, offset, i, valid, max_range, WITH_MOTION, MOVING
        )
        _, across, r, _, a, e, d = spherical(center, axes)
        normal = cross(a, e)
        area, determinant, sloped = determinant_of(a, e, normal, spread_a, spread_e)
        wide_a, wide_e = dot(a, a) + spread_a * spread_a, dot(e, e) + spread_e * spread_e
        store_three(conics, place, wide_e / determinant, -dot(a, e) / determinant, wide_a / determinant, valid)
        safe = tl.where(sloped, area, 1.0)
        slope_a = tl.where(sloped, dot(normal, cross(d, e)) / safe, 0.0)
        slope_e = tl.where(sloped, dot(normal, cross(a, d)) / safe, 0.0)
        tl.store(slopes + 2 * place, slope_a, mask=valid)
        tl.store(slopes + 2 * place + 1, slope_e, mask=valid)
        tl.store(means2d + 2 * place, atan2(center[1], center[0]), mask=valid)
        tl.store(means2d + 2 * place + 1, atan2(center[2], across), mask=valid)
        tl.store(ranges + place, r, mask=valid)
        by_beam = slope_a * slope_a * spread_a * spread_a + slope_e * slope_e * spread_e * spread_e
        tl.store(limits + place, tl.minimum(DEVIATIONS * tl.sqrt(dot(d, d) + by_beam), r), mask=valid)
        reaches = tl.where(seen & (opacity >= FAINTEST), reach, 0.0)
        tl.store(radii + 2 * place, reaches * tl.sqrt(wide_a), mask=valid)
        tl.store(radii + 2 * place + 1, reaches * tl.sqrt(wide_e), mask=valid)


@triton.jit(do_not_specialize=["spread_a", "spread_e", "max_range", "count", "room"])
@no_type_check
def _project_backward(
    means, quats, scales, offsets, view, velocities, v_means2d, v_ranges, v_conics, v_slopes, v_means2d_last,
    v_ranges_last, v_conics_last, v_slopes_last, v_means, v_quats, v_scales, spread_a, spread_e, max_range, count, room,
    WITH_MOTION: tl.constexpr, MOVING: tl.constexpr, PARTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The gradients of Gaussians by those of the first and the last part of a revolution."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid, zero = i < count, tl.zeros((BLOCK,), tl.float32)
    v_center = zero, zero, zero
    v_rows = v_center, v_center, v_center
    w, x, y, z, length = unit(quats, i, valid)
    for part in tl.static_range(PARTS):
        offset = tl.load(offsets + part * room.to(tl.int64) + i, mask=valid, other=0.0)
        given = (
            (v_means2d, v_ranges, v_conics, v_slopes) if part == 0
            else (v_means2d_last, v_ranges_last, v_conics_last, v_slopes_last)
        )  # fmt: skip
        center, seen, axes, _, to_sensor = met(
            means, quats, scales, view, velocities, offset, i, valid, max_range, WITH_MOTION, MOVING
        )
        _, _, _, _, a, e, d = spherical(center, axes)
        by_slopes = two(given[3], i, valid)
        by_a, by_e, by_d = footprint_backward(a, e, d, three(given[2], i, valid), by_slopes, spread_a, spread_e)
        by_azimuth, by_elevation = two(given[0], i, valid)
        by_range = tl.load(given[1] + i, mask=valid, other=0.0)
        by_center, by_axes = spherical_backward(center, axes, by_a, by_e, by_d, by_azimuth, by_elevation, by_range)
        x_moved, y_moved, z_moved = turned_back(to_sensor, by_center)
        moved = tl.where(seen, x_moved, 0.0), tl.where(seen, y_moved, 0.0), tl.where(seen, z_moved, 0.0)
        v_center = added(v_center, moved)
        # rows of the scaled axes in the world
        v_rows = (
            added(v_rows[0], turned_back(by_axes, (to_sensor[0][0], to_sensor[1][0], to_sensor[2][0]))),
            added(v_rows[1], turned_back(by_axes, (to_sensor[0][1], to_sensor[1][1], to_sensor[2][1]))),
            added(v_rows[2], turned_back(by_axes, (to_sensor[0][2], to_sensor[1][2], to_sensor[2][2]))),
        )
    store_three(v_means, i, v_center[0], v_center[1], v_center[2], valid)
    by_scale, by_quat = axes_gradient(v_rows, three(scales, i, valid), w, x, y, z, length)
    store_three(v_scales, i, by_scale[0], by_scale[1], by_scale[2], valid)
    store_quaternion(v_quats, i, by_quat[0], by_quat[1], by_quat[2], by_quat[3], valid)
