"""A readable rasterizer of LiDAR scans in plain torch: every Gaussian on every ray, with gradients by autograd.

Formulas as in SplatAD (CVPR 2025), written with matrices; cut-offs as for images: alpha at most 0.999, contributions
under 1/255 dropped, a ray ends before its transmittance reaches 1e-4.
"""

import math

import torch
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci
from torch import Tensor

from drivesplat.kernels.scanned_gaussians import ScannedGaussians
from drivesplat.rasterization import RayGrid, ScanMotion, ScanRendering
from helpers.reference_rasterizer import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

MIN_RANGE = 0.2
MAX_ELEVATION = math.radians(80.0)


def rasterize_scan_reference(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, values: Tensor, world_to_sensor: Tensor,
    rays: RayGrid, *, beam_spread: tuple[float, float], motion: ScanMotion | None = None, before: Tensor | None = None,
    max_range: float = 200.0,
) -> ScanRendering:  # fmt: skip
    """As `drivesplat.rasterization.rasterize_scan`."""
    firings = torch.arange(rays.azimuths.shape[1])
    if motion is None:
        parts = [firings]
    else:  # where a revolution begins, it ends at another time
        in_time = rays.offsets_s.median(dim=0).values.argsort(stable=True)
        middle = (len(firings) + 1) // 2
        parts = [in_time[:middle], in_time[middle:]][: len(firings)]
    covariances, _ = _quat_scale_to_covar_preci(quats, scales, compute_covar=True, compute_preci=False)
    projected, sums = [], []
    for part in parts:
        own = RayGrid(rays.azimuths[:, part], rays.elevations[:, part], rays.offsets_s[:, part])
        centers = means @ world_to_sensor[:3, :3].T + world_to_sensor[:3, 3]
        rotations = world_to_sensor[:3, :3].expand(len(means), 3, 3)
        if motion is not None:
            turns, shifts = _at_firing(centers.detach(), motion, own, world_to_sensor.detach())
            centers = (turns @ (centers + shifts)[..., None])[..., 0]
            rotations = turns @ rotations
        projected.append(_project(centers, rotations @ covariances @ rotations.mT, opacities, beam_spread, max_range))
        composited = _composite(projected[-1], values, own, None if before is None else before[:, part])
        sums.append([value.reshape(*own.azimuths.shape, *value.shape[1:]) for value in composited])
    places = torch.cat(parts).argsort()
    range_sum, median, alpha, nearer, out = (torch.cat(s, dim=1)[:, places] for s in zip(*sums, strict=True))
    expected = range_sum / alpha.clamp(min=1e-10)
    return ScanRendering(expected, median, alpha, out, None if before is None else nearer, tuple(projected))


def _at_firing(centers: Tensor, motion: ScanMotion, rays: RayGrid, world_to_sensor: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (n, 3, 3) and shifts (n, 3), before them, to the sensor's frame at each Gaussian's time."""
    velocity = -motion.linear.expand_as(centers)
    if motion.velocities is not None:
        velocity = velocity + motion.velocities @ world_to_sensor[:3, :3].T
    x, y, z = motion.angular.tolist()
    skew = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=centers.dtype)
    firing = torch.exp(1j * rays.azimuths).mean(dim=0).angle()
    turns, shifts = [], []
    for center, v in zip(centers, velocity, strict=True):
        seconds = centers.new_zeros(())
        for _ in range(4):
            x, y, _ = torch.matrix_exp(-skew * seconds) @ (center + v * seconds)
            off = torch.exp(1j * (firing - torch.atan2(y, x))).angle().abs()
            seconds = rays.offsets_s.median(dim=0).values[off.argmin()]
        turns.append(torch.matrix_exp(-skew * seconds))
        shifts.append(v * seconds)
    return torch.stack(turns), torch.stack(shifts)


def _project(
    centers: Tensor, covariances: Tensor, opacities: Tensor, beam_spread: tuple[float, float], max_range: float
) -> ScannedGaussians:
    """Gaussians in the sensor's frame as azimuths, elevations and ranges. Skipped ones have radius 0."""
    distance = centers.detach().norm(dim=-1)
    pole = torch.atan2(centers[:, 2].abs(), centers[:, :2].norm(dim=-1)) > MAX_ELEVATION
    seen = (distance >= MIN_RANGE) & (distance <= max_range) & ~pole
    x, y, z = torch.where(seen[:, None], centers, torch.tensor([1.0, 0.0, 0.0]).to(centers)).unbind(-1)
    rho, r, zero = torch.hypot(x, y), torch.sqrt(x * x + y * y + z * z), torch.zeros_like(x)
    jacobian = torch.stack([
        torch.stack([-y / rho**2, x / rho**2, zero], dim=-1),
        torch.stack([-x * z, -y * z, rho**2], dim=-1) / (r**2 * rho)[:, None],
        torch.stack([x, y, z], dim=-1) / r[:, None],
    ], dim=1)  # fmt: skip
    full = jacobian @ covariances @ jacobian.mT
    wide = full[:, :2, :2] + torch.diag(full.new_tensor(beam_spread) ** 2)
    inverse = torch.linalg.inv(wide)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], dim=-1)
    determinant = torch.linalg.det(full[:, :2, :2])
    sloped = determinant > 1e-8 * full[:, 0, 0] * full[:, 1, 1]
    block = torch.where(sloped[:, None, None], full[:, :2, :2], torch.eye(2).to(full))
    slopes = torch.linalg.solve(block, full[:, :2, 2]) * sloped[:, None]
    deviation = torch.sqrt(full[:, 2, 2] + (slopes * full.new_tensor(beam_spread)).square().sum(dim=-1))
    limits = torch.minimum(3.0 * deviation, r).detach()
    radii = (seen & (opacities >= MIN_ALPHA))[:, None] * wide.detach().diagonal(dim1=1, dim2=2).sqrt()
    means2d = torch.stack([torch.atan2(y, x), torch.asin(z / r)], dim=-1)
    return ScannedGaussians(means2d, r, conics, slopes, limits, radii, opacities)


def _composite(gaussians: ScannedGaussians, values: Tensor, rays: RayGrid, before: Tensor | None) -> tuple[Tensor, ...]:
    """Sums of ranges, median ranges, alpha and alpha before (rays,), and values (rays, channels)."""
    order = torch.argsort(gaussians.ranges.detach(), stable=True)
    order = order[(gaussians.radii[order] > 0).all(dim=-1)]
    means2d, ranges, conics, slopes, limits, _, opacities = (tensor[order] for tensor in gaussians)
    da = rays.azimuths.reshape(-1, 1) - means2d[:, 0]
    da = torch.remainder(da + math.pi, 2.0 * math.pi) - math.pi
    de = rays.elevations.reshape(-1, 1) - means2d[:, 1]
    a, b, c = conics.unbind(-1)
    alpha = (opacities * torch.exp(-0.5 * (a * da**2 + c * de**2) - b * da * de)).clamp(max=MAX_ALPHA)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0.0)
    after = torch.cumprod(1.0 - alpha, dim=-1)
    alpha = torch.where(after > MIN_TRANSMITTANCE, alpha, 0.0)
    remaining = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1.0 - alpha], dim=-1), dim=-1)
    weights = alpha * remaining[:, :-1]
    distance = ranges + torch.clamp(slopes[:, 0] * da + slopes[:, 1] * de, -limits, limits)
    crossing = (remaining[:, :-1] > 0.5) & (remaining[:, 1:] <= 0.5)
    nearer = distance < (torch.zeros_like(da[:, :1]) if before is None else before.reshape(-1, 1))
    return (
        (weights * distance).sum(dim=-1), (distance * crossing).sum(dim=-1).detach(), weights.sum(dim=-1),
        (weights * nearer).sum(dim=-1), weights @ values[order],
    )  # fmt: skip
