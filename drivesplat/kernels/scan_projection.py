"""Spherical projection of Gaussians into a LiDAR scan (SplatAD, CVPR 2025), in torch operations on any device.

In the sensor's frame at x, y, z, with ρ² = x² + y² and r² = ρ² + z², the Jacobian's rows are those of azimuth
atan2(y, x): (−y, x, 0) / ρ²; of elevation asin(z / r): (−x z, −y z, ρ²) / (r² ρ); and of range r: (x, y, z) / r. With
T = J W R S (scales S, rotation R, world to sensor W) and T's rows a, e and d, the covariance of azimuth and elevation
has the determinant |a × e|², which neither cancels nor turns negative as xx yy - xy² does for needles in float32.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from drivesplat.kernels import triton_support
from drivesplat.kernels.scanned_gaussians import (
    FIRING_STEPS,
    MAX_DEVIATIONS,
    MIN_ALPHA,
    MIN_RANGE,
    MIN_SINE_SQUARED,
    SINE_OF_POLES,
    Revolution,
    ScannedGaussians,
)

SERIAL = 32768
"""Number of values up to which torch uses one thread."""


class SensorPlacement(NamedTuple):
    """Where Gaussians are in the sensor's frame, and how they lie: centres (3, n) in metres, and axes (3, 3, n): the
    scaled principal axes, coordinates first."""

    centers: Float[Tensor, "3 n"]
    axes: Float[Tensor, "3 3 n"]


def scanned(
    means: Float[Tensor, "n 3"], quats: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"], world_to_sensor: Float[Tensor, "4 4"], revolutions: Sequence[Revolution] | None,
    beam_spread: tuple[float, float], max_range: float,
) -> list[ScannedGaussians]:  # fmt: skip
    """Gaussians as a LiDAR sees them, for each of the parts of a revolution: they are where its beams meet them. There
    are one or two parts, which differ in their firings. None: one part, whose rays share one time.

    `beam_spread` are the standard deviations (radians) of the beams' footprint in azimuth and elevation, which
    Gaussians are widened by. The times are taken as constants: gradients treat a Gaussian as if it always met the
    beams at the same time. In Triton on a GPU, unless the gradient of the pose is wanted, in torch elsewhere.
    """
    if triton_support.usable_for(means) and means.dtype == torch.float32 and not world_to_sensor.requires_grad:
        from drivesplat.kernels.triton.scan_projection import ScanProjection, sensor_motion

        motion = sensor_motion(world_to_sensor, revolutions)
        projected = ScanProjection.apply(means, quats, scales, opacities, motion, beam_spread, max_range)
        return [ScannedGaussians(*projected[at : at + 6], opacities) for at in range(0, len(projected), 6)]
    gaussians = _placed(means, quats, scales, world_to_sensor)
    parts = [gaussians] if revolutions is None else [_at_firing(gaussians, it, world_to_sensor) for it in revolutions]
    return [_project(part, opacities, beam_spread, max_range) for part in parts]


def _placed(
    means: Float[Tensor, "n 3"], quats: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"],
    world_to_sensor: Float[Tensor, "4 4"],
) -> SensorPlacement:  # fmt: skip
    """The Gaussians in the sensor's frame at the sweep's timestamp."""
    w, x, y, z = normalize(quats, dim=-1).T.unbind()
    xx, yy, zz, xy, xz, yz = 2 * x * x, 2 * y * y, 2 * z * z, 2 * x * y, 2 * x * z, 2 * y * z
    wx, wy, wz = 2 * w * x, 2 * w * y, 2 * w * z
    rotations = torch.stack([
        1 - yy - zz, xy - wz, xz + wy,
        xy + wz, 1 - xx - zz, yz - wx,
        xz - wy, yz + wx, 1 - xx - yy,
    ]).reshape(3, 3, -1)  # fmt: skip
    rotation, translation = world_to_sensor[:3, :3, None], world_to_sensor[:3, 3:]
    axes = _turned(rotation, (rotations * scales.T).reshape(3, -1)).reshape(3, 3, -1)
    return SensorPlacement(_turned(rotation, means.T) + translation, axes)


def _at_firing(
    gaussians: SensorPlacement, revolution: Revolution, world_to_sensor: Float[Tensor, "4 4"]
) -> SensorPlacement:
    """The Gaussians in the sensor's frame at the times at which the beams pass them."""
    with torch.no_grad():
        relative = -revolution.linear[:, None].expand_as(gaussians.centers)
        if revolution.velocities is not None:
            relative = relative + _turned(world_to_sensor[:3, :3, None], revolution.velocities.T)
        offsets, firings = gaussians.centers.new_zeros(gaussians.centers.shape[1]), revolution.firings
        for _ in range(FIRING_STEPS):
            x, y = _turned(_turns(-revolution.angular, offsets)[:2], gaussians.centers + relative * offsets)
            offsets = firings.offsets_s[torch.searchsorted(firings.between, _atan2(y, x))]
        turns, moved = _turns(-revolution.angular, offsets), relative * offsets
    axes = torch.stack([_turned(turns, axis) for axis in gaussians.axes.unbind(1)], dim=1)
    return SensorPlacement(_turned(turns, gaussians.centers + moved), axes)


def _length(vectors: Float[Tensor, "3 n"]) -> Float[Tensor, " n"]:
    return (vectors * vectors).sum(dim=0).sqrt()


def _atan2(y: Float[Tensor, " n"], x: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """torch.atan2. Its last bits on a CPU depend on how threads share the values: here, each part has one thread."""
    if y.is_cuda:
        return torch.atan2(y, x)
    return torch.cat([torch.atan2(*part) for part in zip(y.split(SERIAL), x.split(SERIAL), strict=True)])


def _turns(angular: Float[Tensor, "3"], seconds: Float[Tensor, " n"]) -> Float[Tensor, "3 3 n"]:
    """Rotations by an angular velocity over times, after Rodrigues."""
    speed = angular.norm().clamp(min=1e-12)
    x, y, z = (angular / speed).unbind()
    nothing = torch.zeros_like(x)
    cross = torch.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing]).reshape(3, 3, 1)
    twice = (cross[..., 0] @ cross[..., 0])[..., None]
    eye = torch.eye(3, dtype=angular.dtype, device=angular.device)[..., None]
    return eye + torch.sin(speed * seconds) * cross + (1.0 - torch.cos(speed * seconds)) * twice


def _turned(turns: Float[Tensor, "rows 3 #n"], vectors: Float[Tensor, "3 n"]) -> Float[Tensor, "rows n"]:
    """The product, of one matrix or one for each vector. Last bits of a matrix product, and of its gradient, depend on
    the number of threads on some processors."""
    return turns[:, 0] * vectors[0] + turns[:, 1] * vectors[1] + turns[:, 2] * vectors[2]


def _project(
    gaussians: SensorPlacement, opacities: Float[Tensor, " n"], beam_spread: tuple[float, float], max_range: float
) -> ScannedGaussians:
    """Projects Gaussians in the sensor's frame to azimuth, elevation and range."""
    with torch.no_grad():
        distance = _length(gaussians.centers)
        sine = gaussians.centers[2] / distance.clamp(min=MIN_RANGE)
        seen = (distance >= MIN_RANGE) & (distance <= max_range) & (sine.abs() <= SINE_OF_POLES)
        elsewhere = gaussians.centers.new_tensor([1.0, 0.0, 0.0])[:, None]
    x, y, z = torch.where(seen, gaussians.centers, elsewhere).unbind()
    across_squared = x * x + y * y
    across, ranges = across_squared.sqrt(), (across_squared + z * z).sqrt()
    axis_x, axis_y, axis_z = gaussians.axes.unbind()
    outward = x * axis_x + y * axis_y
    a = (x * axis_y - y * axis_x) / across_squared
    e = (across_squared * axis_z - z * outward) / (ranges * ranges * across)
    d = (outward + z * axis_z) / ranges
    conics, slopes, deviations = _footprints(a, e, d, beam_spread)
    with torch.no_grad():
        spread = d.new_tensor(beam_spread)
        variance = (d * d).sum(dim=0) + (slopes * spread).square().sum(dim=1)
        limits = torch.minimum(MAX_DEVIATIONS * variance.sqrt(), ranges)
        reach = (2.0 * torch.log(opacities / MIN_ALPHA).clamp(min=0.0)).sqrt()
        radii = torch.where(seen & (opacities >= MIN_ALPHA), reach * deviations, reach.new_zeros(())).T
    means2d = torch.stack([_atan2(y, x), _atan2(z, across)], dim=-1)
    return ScannedGaussians(means2d, ranges, conics, slopes, limits, radii, opacities)


def _footprints(
    a: Float[Tensor, "3 n"], e: Float[Tensor, "3 n"], d: Float[Tensor, "3 n"], beam_spread: tuple[float, float]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 2"], Float[Tensor, "2 n"]]:
    """Conics, slopes and standard deviations of the widened footprints of Gaussians, by the rows of T.

    The slopes are those of the Gaussian itself, without the beams' footprint: between the Gaussians of a plane they
    extrapolate the plane.
    """
    spread_a, spread_e = beam_spread[0] ** 2, beam_spread[1] ** 2
    aa, ae, ee = (a * a).sum(dim=0), (a * e).sum(dim=0), (e * e).sum(dim=0)
    normal = torch.linalg.cross(a, e, dim=0)
    area = (normal * normal).sum(dim=0)
    determinant = area + spread_e * aa + spread_a * ee + spread_a * spread_e
    determinant = determinant.clamp(min=torch.finfo(a.dtype).tiny)
    wide_a, wide_e = aa + spread_a, ee + spread_e
    conics = torch.stack([wide_e, -ae, wide_a], dim=-1) / determinant[:, None]
    sloped = (area > MIN_SINE_SQUARED * aa * ee) & (area > 0)
    safe = torch.where(sloped, area, 1.0)
    by_a = (normal * torch.linalg.cross(d, e, dim=0)).sum(dim=0) / safe
    by_e = (normal * torch.linalg.cross(a, d, dim=0)).sum(dim=0) / safe
    slopes = torch.where(sloped[:, None], torch.stack([by_a, by_e], dim=-1), 0.0)
    return conics, slopes, torch.stack([wide_a, wide_e]).detach().sqrt()
