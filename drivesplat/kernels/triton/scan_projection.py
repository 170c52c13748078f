"""Spherical projection of Gaussians into a LiDAR scan in one pass, and the gradient in another.

As `drivesplat.kernels.scan_projection`, whose formulas these are. With M the product of the rotations from world to
sensor and of the sensor's turn until a Gaussian is met, the axes of a Gaussian in the sensor's frame are M R S; their
rows x, y and z give the rows a, e and d of azimuth, elevation and range. The gradient of a cross product p x q is
q x g for p and g x p for q.
"""

from typing import Any, NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.scanned_gaussians import FIRING_STEPS, MAX_DEVIATIONS, MIN_ALPHA, Revolution
from drivesplat.kernels.triton.rows import store_quaternion, store_three, three, unit
from drivesplat.kernels.triton.scan_geometry import (
    at_timestamp,
    determinant_of,
    footprint_backward,
    met,
    offsets_at,
    spherical,
    spherical_backward,
    times,
    turn_of,
)
from drivesplat.kernels.triton.vectors import added, atan2, cross, dot, rotation_gradient, scaled, turned_back

BLOCK = 128
"""Gaussians per program."""
FAINTEST, DEVIATIONS = tl.constexpr(MIN_ALPHA), tl.constexpr(MAX_DEVIATIONS)


class SensorMotion(NamedTuple):
    """What `ScanProjection` needs to know of a revolution, as tensors: `view`, the rows of the rotation from world to
    sensor, the translation (metres), and the sensor's velocity and angular velocity in its own frame (m/s, rad/s);
    `velocities` of the Gaussians in the world (m/s), or an empty tensor; `middles`, the azimuths between the firings;
    and the `offsets_s` of the firing before and after each."""

    view: Float[Tensor, "18"]
    velocities: Float[Tensor, " v"]
    middles: Float[Tensor, " f"]
    offsets_s: Float[Tensor, " g"]


def sensor_motion(world_to_sensor: Float[Tensor, "4 4"], revolution: Revolution | None) -> SensorMotion:
    """The motion during a revolution; None: rays share one time."""
    pose = [world_to_sensor[:3, :3].flatten(), world_to_sensor[:3, 3]]
    if revolution is None:
        view, nothing = torch.cat([*pose, world_to_sensor.new_zeros(6)]), world_to_sensor.new_empty(0)
        return SensorMotion(view, nothing, nothing, nothing)
    view, velocities = torch.cat([*pose, revolution.linear, revolution.angular]), revolution.velocities
    velocities = view.new_empty(0) if velocities is None else velocities.flatten()
    return SensorMotion(view, velocities, *revolution.firings)


class ScanProjection(torch.autograd.Function):
    """The first six fields of `drivesplat.kernels.scan_projection.ScannedGaussians`. Gradients reach means, quats and
    scales."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, motion: SensorMotion,
        beam_spread: tuple[float, float], max_range: float,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        gaussians = tuple(values.contiguous() for values in (means, quats, scales))
        count, sizes = len(means), ((2,), (), (3,), (2,), (), (2,), ())
        *projected, offsets = (means.new_empty(count, *size) for size in sizes)
        ctx.options = (*beam_spread, max_range)
        if count:
            _project[(triton.cdiv(count, BLOCK),)](
                *gaussians, opacities.contiguous(), *motion, *projected, offsets, len(motion.middles),
                len(motion.offsets_s).bit_length(), *ctx.options, count,
                len(motion.middles) > 0, len(motion.velocities) > 0, FIRING_STEPS, BLOCK,
            )  # fmt: skip
        ctx.motion = motion
        ctx.save_for_backward(*gaussians, offsets)
        ctx.mark_non_differentiable(*projected[4:])
        return tuple(projected)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *gaussians, offsets = ctx.saved_tensors
        v_gaussians = tuple(torch.empty_like(values) for values in gaussians)
        count, motion = len(offsets), ctx.motion
        if count:
            _project_backward[(triton.cdiv(count, BLOCK),)](
                *gaussians, offsets, motion.view, motion.velocities, *(values.contiguous() for values in gradients[:4]),
                *v_gaussians, *ctx.options, count, len(motion.middles) > 0, len(motion.velocities) > 0, BLOCK,
            )  # fmt: skip
        return *v_gaussians, None, None, None, None


@triton.jit(do_not_specialize=["firings", "steps", "spread_a", "spread_e", "max_range", "count"])
@no_type_check
def _project(
    means, quats, scales, opacities, view, velocities, middles, offsets_s, means2d, ranges, conics, slopes, limits,
    radii, offsets, firings, steps, spread_a, spread_e, max_range, count,
    WITH_MOTION: tl.constexpr, MOVING: tl.constexpr, STEPS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    offset = tl.zeros((BLOCK,), tl.float32)
    if WITH_MOTION:
        center, velocity = at_timestamp(means, velocities, view, i, valid, MOVING)
        for _ in range(STEPS):
            turn, moved = turn_of(view, offset), added(center, scaled(offset, velocity))
            offset = offsets_at(atan2(dot(turn[1], moved), dot(turn[0], moved)), middles, offsets_s, firings, steps)
    tl.store(offsets + i, offset, mask=valid)
    center, seen, axes, _, _ = met(
        means, quats, scales, view, velocities, offset, i, valid, max_range, WITH_MOTION, MOVING
    )
    _, across, r, _, a, e, d = spherical(center, axes)
    normal = cross(a, e)
    area, determinant, sloped = determinant_of(a, e, normal, spread_a, spread_e)
    wide_a, wide_e = dot(a, a) + spread_a * spread_a, dot(e, e) + spread_e * spread_e
    store_three(conics, i, wide_e / determinant, -dot(a, e) / determinant, wide_a / determinant, valid)
    safe = tl.where(sloped, area, 1.0)
    slope_a = tl.where(sloped, dot(normal, cross(d, e)) / safe, 0.0)
    slope_e = tl.where(sloped, dot(normal, cross(a, d)) / safe, 0.0)
    tl.store(slopes + 2 * i, slope_a, mask=valid)
    tl.store(slopes + 2 * i + 1, slope_e, mask=valid)
    tl.store(means2d + 2 * i, atan2(center[1], center[0]), mask=valid)
    tl.store(means2d + 2 * i + 1, atan2(center[2], across), mask=valid)
    tl.store(ranges + i, r, mask=valid)
    by_beam = slope_a * slope_a * spread_a * spread_a + slope_e * slope_e * spread_e * spread_e
    tl.store(limits + i, tl.minimum(DEVIATIONS * tl.sqrt(dot(d, d) + by_beam), r), mask=valid)
    opacity = tl.load(opacities + i, mask=valid, other=0.0)
    reach = tl.sqrt(2.0 * tl.log(tl.maximum(opacity / FAINTEST, 1.0)))
    reach = tl.where(seen & (opacity >= FAINTEST), reach, 0.0)
    tl.store(radii + 2 * i, reach * tl.sqrt(wide_a), mask=valid)
    tl.store(radii + 2 * i + 1, reach * tl.sqrt(wide_e), mask=valid)


@triton.jit(do_not_specialize=["spread_a", "spread_e", "max_range", "count"])
@no_type_check
def _project_backward(
    means, quats, scales, offsets, view, velocities, v_means2d, v_ranges, v_conics, v_slopes, v_means, v_quats,
    v_scales, spread_a, spread_e, max_range, count, WITH_MOTION: tl.constexpr, MOVING: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    offset = tl.load(offsets + i, mask=valid, other=0.0)
    center, seen, axes, rotation, to_sensor = met(
        means, quats, scales, view, velocities, offset, i, valid, max_range, WITH_MOTION, MOVING
    )
    _, _, _, _, a, e, d = spherical(center, axes)
    by_slopes = tl.load(v_slopes + 2 * i, mask=valid, other=0.0), tl.load(v_slopes + 2 * i + 1, mask=valid, other=0.0)
    by_a, by_e, by_d = footprint_backward(a, e, d, three(v_conics, i, valid), by_slopes, spread_a, spread_e)
    by_center, by_axes = spherical_backward(
        center, axes, by_a, by_e, by_d, tl.load(v_means2d + 2 * i, mask=valid, other=0.0),
        tl.load(v_means2d + 2 * i + 1, mask=valid, other=0.0), tl.load(v_ranges + i, mask=valid, other=0.0),
    )  # fmt: skip
    x, y, z = turned_back(to_sensor, by_center)
    store_three(v_means, i, tl.where(seen, x, 0.0), tl.where(seen, y, 0.0), tl.where(seen, z, 0.0), valid)
    # rows of the scaled axes in the world
    by_rows = (
        turned_back(by_axes, (to_sensor[0][0], to_sensor[1][0], to_sensor[2][0])),
        turned_back(by_axes, (to_sensor[0][1], to_sensor[1][1], to_sensor[2][1])),
        turned_back(by_axes, (to_sensor[0][2], to_sensor[1][2], to_sensor[2][2])),
    )
    x, y, z = added(
        times(by_rows[0], rotation[0]), added(times(by_rows[1], rotation[1]), times(by_rows[2], rotation[2]))
    )
    store_three(v_scales, i, x, y, z, valid)
    size = three(scales, i, valid)
    by_rotation = times(by_rows[0], size), times(by_rows[1], size), times(by_rows[2], size)
    w, x, y, z, length = unit(quats, i, valid)
    gw, gx, gy, gz = rotation_gradient(w, x, y, z, by_rotation)
    radial = gw * w + gx * x + gy * y + gz * z
    gw, gx, gy, gz = gw - radial * w, gx - radial * x, gy - radial * y, gz - radial * z
    store_quaternion(v_quats, i, gw / length, gx / length, gy / length, gz / length, valid)
