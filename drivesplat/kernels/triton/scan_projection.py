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

from drivesplat.kernels.scan_projection import (
    FIRING_STEPS,
    MAX_DEVIATIONS,
    MIN_ALPHA,
    MIN_RANGE,
    MIN_SINE_SQUARED,
    SINE_OF_POLES,
    Revolution,
)
from drivesplat.kernels.triton.rows import store_quaternion, store_three, three, unit
from drivesplat.kernels.triton.vectors import atan2, cross, dot, rotation_gradient, rotation_rows, turn_rows

BLOCK = 128
"""Gaussians per program."""
TINY = tl.constexpr(1.1754943508222875e-38)
"""The smallest normal number of float32."""
FIRST_SINE, SINE_LIMIT = tl.constexpr(MIN_SINE_SQUARED), tl.constexpr(SINE_OF_POLES)
NEAREST, FAINTEST, DEVIATIONS = tl.constexpr(MIN_RANGE), tl.constexpr(MIN_ALPHA), tl.constexpr(MAX_DEVIATIONS)


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
    return SensorMotion(view, velocities, *revolution.firings.between())


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


@triton.jit
@no_type_check
def _relative(view, velocities, i, valid, MOVING: tl.constexpr):
    """Velocities of Gaussians relative to the sensor, in its frame."""
    x, y, z = -tl.load(view + 12), -tl.load(view + 13), -tl.load(view + 14)
    if MOVING:
        vx, vy, vz = three(velocities, i, valid)
        x += tl.load(view) * vx + tl.load(view + 1) * vy + tl.load(view + 2) * vz
        y += tl.load(view + 3) * vx + tl.load(view + 4) * vy + tl.load(view + 5) * vz
        z += tl.load(view + 6) * vx + tl.load(view + 7) * vy + tl.load(view + 8) * vz
    return x, y, z


@triton.jit
@no_type_check
def _centers(means, view, i, valid):
    """Centres in the sensor's frame at the timestamp."""
    mx, my, mz = three(means, i, valid)
    x = tl.load(view) * mx + tl.load(view + 1) * my + tl.load(view + 2) * mz + tl.load(view + 9)
    y = tl.load(view + 3) * mx + tl.load(view + 4) * my + tl.load(view + 5) * mz + tl.load(view + 10)
    z = tl.load(view + 6) * mx + tl.load(view + 7) * my + tl.load(view + 8) * mz + tl.load(view + 11)
    return x, y, z


@triton.jit
@no_type_check
def _offsets_at(azimuth, middles, offsets_s, count, steps):
    """The times of the firings nearest to azimuths, by a binary search."""
    low, high = tl.zeros_like(azimuth).to(tl.int32), tl.zeros_like(azimuth).to(tl.int32) + count
    for _ in range(steps):
        middle = (low + high) // 2
        below = (low < high) & (tl.load(middles + middle, mask=middle < count, other=float("inf")) < azimuth)
        low, high = tl.where(below, middle + 1, low), tl.where(below, high, middle)
    return tl.load(offsets_s + low)


@triton.jit
@no_type_check
def _to_sensor(view, offset, WITH_MOTION: tl.constexpr):
    """The rows of the sensor's turn until a time, and of its product with the rotation from world to sensor."""
    zero = tl.zeros_like(offset)
    t0, t1, t2, t3, t4, t5, t6, t7, t8 = zero + 1.0, zero, zero, zero, zero + 1.0, zero, zero, zero, zero + 1.0
    if WITH_MOTION:
        t0, t1, t2, t3, t4, t5, t6, t7, t8 = turn_rows(
            -tl.load(view + 15), -tl.load(view + 16), -tl.load(view + 17), offset
        )
    w0, w1, w2, w3, w4 = tl.load(view), tl.load(view + 1), tl.load(view + 2), tl.load(view + 3), tl.load(view + 4)
    w5, w6, w7, w8 = tl.load(view + 5), tl.load(view + 6), tl.load(view + 7), tl.load(view + 8)
    m0, m1, m2 = dot(t0, t1, t2, w0, w3, w6), dot(t0, t1, t2, w1, w4, w7), dot(t0, t1, t2, w2, w5, w8)
    m3, m4, m5 = dot(t3, t4, t5, w0, w3, w6), dot(t3, t4, t5, w1, w4, w7), dot(t3, t4, t5, w2, w5, w8)
    m6, m7, m8 = dot(t6, t7, t8, w0, w3, w6), dot(t6, t7, t8, w1, w4, w7), dot(t6, t7, t8, w2, w5, w8)
    return t0, t1, t2, t3, t4, t5, t6, t7, t8, m0, m1, m2, m3, m4, m5, m6, m7, m8


@triton.jit
@no_type_check
def _met(
    means, quats, scales, view, velocities, offset, i, valid, max_range, WITH_MOTION: tl.constexpr, MOVING: tl.constexpr
):
    """Where Gaussians are when the beams meet them, whether they are seen, and their axes by coordinate; also the
    rows of their rotation, and of that from world to sensor."""
    cx, cy, cz = _centers(means, view, i, valid)
    vx, vy, vz = _relative(view, velocities, i, valid, MOVING)
    cx, cy, cz = cx + vx * offset, cy + vy * offset, cz + vz * offset
    t0, t1, t2, t3, t4, t5, t6, t7, t8, m0, m1, m2, m3, m4, m5, m6, m7, m8 = _to_sensor(view, offset, WITH_MOTION)
    x, y, z = dot(t0, t1, t2, cx, cy, cz), dot(t3, t4, t5, cx, cy, cz), dot(t6, t7, t8, cx, cy, cz)
    distance = tl.sqrt(x * x + y * y + z * z)
    seen = valid & (distance >= NEAREST) & (distance <= max_range)
    seen &= tl.abs(z) <= SINE_LIMIT * tl.maximum(distance, NEAREST)
    x, y, z = tl.where(seen, x, 1.0), tl.where(seen, y, 0.0), tl.where(seen, z, 0.0)
    w, qx, qy, qz, _ = unit(quats, i, valid)
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_rows(w, qx, qy, qz)
    s0, s1, s2 = three(scales, i, valid)
    x0, x1, x2 = s0 * dot(m0, m1, m2, r0, r3, r6), s1 * dot(m0, m1, m2, r1, r4, r7), s2 * dot(m0, m1, m2, r2, r5, r8)
    y0, y1, y2 = s0 * dot(m3, m4, m5, r0, r3, r6), s1 * dot(m3, m4, m5, r1, r4, r7), s2 * dot(m3, m4, m5, r2, r5, r8)
    z0, z1, z2 = s0 * dot(m6, m7, m8, r0, r3, r6), s1 * dot(m6, m7, m8, r1, r4, r7), s2 * dot(m6, m7, m8, r2, r5, r8)
    return (
        x, y, z, seen, x0, x1, x2, y0, y1, y2, z0, z1, z2, r0, r1, r2, r3, r4, r5, r6, r7, r8,
        m0, m1, m2, m3, m4, m5, m6, m7, m8,
    )  # fmt: skip


@triton.jit
@no_type_check
def _spherical(x, y, z, x0, x1, x2, y0, y1, y2, z0, z1, z2):
    """Squared distance from the axis, the same not squared, and range; the outward axes and the rows a, e and d."""
    squared = x * x + y * y
    across = tl.sqrt(squared)
    r = tl.sqrt(squared + z * z)
    o0, o1, o2 = x * x0 + y * y0, x * x1 + y * y1, x * x2 + y * y2
    a0, a1, a2 = (x * y0 - y * x0) / squared, (x * y1 - y * x1) / squared, (x * y2 - y * x2) / squared
    low = 1.0 / (r * r * across)
    e0, e1, e2 = (squared * z0 - z * o0) * low, (squared * z1 - z * o1) * low, (squared * z2 - z * o2) * low
    d0, d1, d2 = (o0 + z * z0) / r, (o1 + z * z1) / r, (o2 + z * z2) / r
    return squared, across, r, o0, o1, o2, a0, a1, a2, e0, e1, e2, d0, d1, d2


@triton.jit
@no_type_check
def _footprint(a0, a1, a2, e0, e1, e2, spread_a, spread_e):
    """Variances of azimuth and elevation, their covariance, the normal a x e and its square, the determinant of the
    widened footprint, and whether the Gaussian has a slope."""
    aa, ae, ee = dot(a0, a1, a2, a0, a1, a2), dot(a0, a1, a2, e0, e1, e2), dot(e0, e1, e2, e0, e1, e2)
    n0, n1, n2 = cross(a0, a1, a2, e0, e1, e2)
    area = dot(n0, n1, n2, n0, n1, n2)
    wide_a, wide_e = spread_a * spread_a, spread_e * spread_e
    determinant = tl.maximum(area + wide_e * aa + wide_a * ee + wide_a * wide_e, TINY)
    sloped = (area > FIRST_SINE * aa * ee) & (area > 0.0)
    return aa, ae, ee, n0, n1, n2, area, determinant, sloped


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
        cx, cy, cz = _centers(means, view, i, valid)
        vx, vy, vz = _relative(view, velocities, i, valid, MOVING)
        for _ in range(STEPS):
            t0, t1, t2, t3, t4, t5, t6, t7, t8 = turn_rows(
                -tl.load(view + 15), -tl.load(view + 16), -tl.load(view + 17), offset
            )
            x, y, z = cx + vx * offset, cy + vy * offset, cz + vz * offset
            azimuth = atan2(dot(t3, t4, t5, x, y, z), dot(t0, t1, t2, x, y, z))
            offset = _offsets_at(azimuth, middles, offsets_s, firings, steps)
    tl.store(offsets + i, offset, mask=valid)
    (
        x, y, z, seen, x0, x1, x2, y0, y1, y2, z0, z1, z2, r0, r1, r2, r3, r4, r5, r6, r7, r8,
        m0, m1, m2, m3, m4, m5, m6, m7, m8,
    ) = _met(means, quats, scales, view, velocities, offset, i, valid, max_range, WITH_MOTION, MOVING)  # fmt: skip
    squared, across, r, o0, o1, o2, a0, a1, a2, e0, e1, e2, d0, d1, d2 = _spherical(
        x, y, z, x0, x1, x2, y0, y1, y2, z0, z1, z2
    )
    aa, ae, ee, n0, n1, n2, area, determinant, sloped = _footprint(a0, a1, a2, e0, e1, e2, spread_a, spread_e)
    wide_a, wide_e = aa + spread_a * spread_a, ee + spread_e * spread_e
    store_three(conics, i, wide_e / determinant, -ae / determinant, wide_a / determinant, valid)
    safe = tl.where(sloped, area, 1.0)
    c0, c1, c2 = cross(d0, d1, d2, e0, e1, e2)
    slope_a = tl.where(sloped, dot(n0, n1, n2, c0, c1, c2) / safe, 0.0)
    c0, c1, c2 = cross(a0, a1, a2, d0, d1, d2)
    slope_e = tl.where(sloped, dot(n0, n1, n2, c0, c1, c2) / safe, 0.0)
    tl.store(slopes + 2 * i, slope_a, mask=valid)
    tl.store(slopes + 2 * i + 1, slope_e, mask=valid)
    tl.store(means2d + 2 * i, atan2(y, x), mask=valid)
    tl.store(means2d + 2 * i + 1, atan2(z, across), mask=valid)
    tl.store(ranges + i, r, mask=valid)
    by_beam = slope_a * slope_a * spread_a * spread_a + slope_e * slope_e * spread_e * spread_e
    tl.store(limits + i, tl.minimum(DEVIATIONS * tl.sqrt(dot(d0, d1, d2, d0, d1, d2) + by_beam), r), mask=valid)
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
    (
        x, y, z, seen, x0, x1, x2, y0, y1, y2, z0, z1, z2, r0, r1, r2, r3, r4, r5, r6, r7, r8,
        m0, m1, m2, m3, m4, m5, m6, m7, m8,
    ) = _met(means, quats, scales, view, velocities, offset, i, valid, max_range, WITH_MOTION, MOVING)  # fmt: skip
    squared, across, r, o0, o1, o2, a0, a1, a2, e0, e1, e2, d0, d1, d2 = _spherical(
        x, y, z, x0, x1, x2, y0, y1, y2, z0, z1, z2
    )
    aa, ae, ee, n0, n1, n2, area, determinant, sloped = _footprint(a0, a1, a2, e0, e1, e2, spread_a, spread_e)

    # conics
    g0, g1, g2 = three(v_conics, i, valid)
    wide_a, wide_e = spread_a * spread_a, spread_e * spread_e
    by_determinant = -(g0 * (ee + wide_e) - g1 * ae + g2 * (aa + wide_a)) / determinant / determinant
    by_aa = g2 / determinant + wide_e * by_determinant
    by_ee = g0 / determinant + wide_a * by_determinant
    by_ae = -g1 / determinant
    # slopes: h0 n·(d x e) / area and h1 n·(a x d) / area
    safe = tl.where(sloped, area, 1.0)
    h0 = tl.where(sloped, tl.load(v_slopes + 2 * i, mask=valid, other=0.0), 0.0) / safe
    h1 = tl.where(sloped, tl.load(v_slopes + 2 * i + 1, mask=valid, other=0.0), 0.0) / safe
    p0, p1, p2 = cross(d0, d1, d2, e0, e1, e2)
    q0, q1, q2 = cross(a0, a1, a2, d0, d1, d2)
    s0, s1, s2 = h0 * p0 + h1 * q0, h0 * p1 + h1 * q1, h0 * p2 + h1 * q2
    by_area = by_determinant - dot(n0, n1, n2, s0, s1, s2) / safe
    s0, s1, s2 = s0 + 2.0 * by_area * n0, s1 + 2.0 * by_area * n1, s2 + 2.0 * by_area * n2
    va0, va1, va2 = cross(e0, e1, e2, s0, s1, s2)
    ve0, ve1, ve2 = cross(s0, s1, s2, a0, a1, a2)
    p0, p1, p2 = h0 * n0, h0 * n1, h0 * n2
    q0, q1, q2 = h1 * n0, h1 * n1, h1 * n2
    vd0, vd1, vd2 = cross(e0, e1, e2, p0, p1, p2)
    c0, c1, c2 = cross(p0, p1, p2, d0, d1, d2)
    ve0, ve1, ve2 = ve0 + c0, ve1 + c1, ve2 + c2
    c0, c1, c2 = cross(d0, d1, d2, q0, q1, q2)
    va0, va1, va2 = va0 + c0, va1 + c1, va2 + c2
    c0, c1, c2 = cross(q0, q1, q2, a0, a1, a2)
    vd0, vd1, vd2 = vd0 + c0, vd1 + c1, vd2 + c2
    va0, ve0 = va0 + 2.0 * by_aa * a0 + by_ae * e0, ve0 + 2.0 * by_ee * e0 + by_ae * a0
    va1, ve1 = va1 + 2.0 * by_aa * a1 + by_ae * e1, ve1 + 2.0 * by_ee * e1 + by_ae * a1
    va2, ve2 = va2 + 2.0 * by_aa * a2 + by_ae * e2, ve2 + 2.0 * by_ee * e2 + by_ae * a2

    # the rows a, e and d
    low = 1.0 / (r * r * across)
    vo0, vo1, vo2 = vd0 / r - z * low * ve0, vd1 / r - z * low * ve1, vd2 / r - z * low * ve2
    vx0, vx1, vx2 = x * vo0 - y / squared * va0, x * vo1 - y / squared * va1, x * vo2 - y / squared * va2
    vy0, vy1, vy2 = y * vo0 + x / squared * va0, y * vo1 + x / squared * va1, y * vo2 + x / squared * va2
    flat, up = squared * low, z / r
    vz0, vz1, vz2 = flat * ve0 + up * vd0, flat * ve1 + up * vd1, flat * ve2 + up * vd2
    by_x = dot(va0, va1, va2, y0, y1, y2) / squared + dot(vo0, vo1, vo2, x0, x1, x2)
    by_y = -dot(va0, va1, va2, x0, x1, x2) / squared + dot(vo0, vo1, vo2, y0, y1, y2)
    by_z = dot(vd0, vd1, vd2, z0, z1, z2) / r - dot(ve0, ve1, ve2, o0, o1, o2) * low
    along_e = dot(ve0, ve1, ve2, e0, e1, e2)
    by_r = tl.load(v_ranges + i, mask=valid, other=0.0) - (2.0 * along_e + dot(vd0, vd1, vd2, d0, d1, d2)) / r
    by_across = -along_e / across
    by_squared = dot(ve0, ve1, ve2, z0, z1, z2) * low - dot(va0, va1, va2, a0, a1, a2) / squared
    # azimuth and elevation
    by_azimuth = tl.load(v_means2d + 2 * i, mask=valid, other=0.0)
    by_elevation = tl.load(v_means2d + 2 * i + 1, mask=valid, other=0.0)
    by_z += across / (r * r) * by_elevation + z / r * by_r
    by_across -= z / (r * r) * by_elevation
    by_squared += 0.5 * by_across / across + 0.5 * by_r / r
    by_x += 2.0 * x * by_squared - y / squared * by_azimuth
    by_y += 2.0 * y * by_squared + x / squared * by_azimuth

    by_x, by_y, by_z = tl.where(seen, by_x, 0.0), tl.where(seen, by_y, 0.0), tl.where(seen, by_z, 0.0)
    store_three(
        v_means, i, dot(m0, m3, m6, by_x, by_y, by_z), dot(m1, m4, m7, by_x, by_y, by_z),
        dot(m2, m5, m8, by_x, by_y, by_z), valid,
    )  # fmt: skip
    # the scaled axes in the world
    b0, b1, b2 = dot(m0, m3, m6, vx0, vy0, vz0), dot(m0, m3, m6, vx1, vy1, vz1), dot(m0, m3, m6, vx2, vy2, vz2)
    b3, b4, b5 = dot(m1, m4, m7, vx0, vy0, vz0), dot(m1, m4, m7, vx1, vy1, vz1), dot(m1, m4, m7, vx2, vy2, vz2)
    b6, b7, b8 = dot(m2, m5, m8, vx0, vy0, vz0), dot(m2, m5, m8, vx1, vy1, vz1), dot(m2, m5, m8, vx2, vy2, vz2)
    store_three(
        v_scales, i, dot(b0, b3, b6, r0, r3, r6), dot(b1, b4, b7, r1, r4, r7), dot(b2, b5, b8, r2, r5, r8), valid
    )
    s0, s1, s2 = three(scales, i, valid)
    w, qx, qy, qz, length = unit(quats, i, valid)
    gw, gx, gy, gz = rotation_gradient(
        w, qx, qy, qz, b0 * s0, b1 * s1, b2 * s2, b3 * s0, b4 * s1, b5 * s2, b6 * s0, b7 * s1, b8 * s2
    )
    radial = gw * w + gx * qx + gy * qy + gz * qz
    gw, gx, gy, gz = gw - radial * w, gx - radial * qx, gy - radial * qy, gz - radial * qz
    store_quaternion(v_quats, i, gw / length, gx / length, gy / length, gz / length, valid)
