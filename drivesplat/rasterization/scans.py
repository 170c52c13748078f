"""The rasterization of LiDAR scans, on any device, and its result."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.scan_compositing import CompositedScan, composite_scan
from drivesplat.kernels.scan_part import MetPart, ScanPart
from drivesplat.kernels.scan_projection import scanned
from drivesplat.kernels.scanned_gaussians import Revolution, ScannedGaussians
from drivesplat.scene.scan import ScanRays

MAX_RANGE = 200.0
"""Metres beyond which no LiDAR of a vehicle measures."""


@dataclass(frozen=True)
class RayGrid:
    """The rays of b beams and a firings as tensors: `ScanRays` on a device."""

    azimuths: Float[Tensor, "b a"]
    elevations: Float[Tensor, "b a"]
    offsets_s: Float[Tensor, "b a"]

    @classmethod
    def of(cls, rays: ScanRays, like: Tensor) -> "RayGrid":
        """The rays with the device and type of `like`."""
        return cls(*(torch.from_numpy(array).to(like) for array in (rays.azimuths, rays.elevations, rays.offsets_s)))

    @cached_property
    def whole(self) -> ScanPart:
        """All rays."""
        return ScanPart(*self.rays)

    @cached_property
    def halves(self) -> "Halves":
        """The rays of the first and of the second half of a revolution, by time; without an empty half."""
        times = self.offsets_s.median(dim=0).values
        order = times.argsort(stable=True)
        firings = (half for half in order.tensor_split(2) if len(half))
        parts = [ScanPart(*(values[:, half] for values in self.rays)) for half in firings]
        return Halves(parts, order, None if bool((times.diff() >= 0).all()) else order.argsort())

    @property
    def rays(self) -> tuple[Float[Tensor, "b a"], Float[Tensor, "b a"], Float[Tensor, "b a"]]:
        """Azimuths, elevations and times."""
        return self.azimuths, self.elevations, self.offsets_s

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors that a rendering with motion reads, in a fixed order."""
        return [*self.rays, *self.halves.tensors]


@dataclass(frozen=True)
class Halves:
    """The halves of a revolution as `parts`, the firings of the scan in the `order` of their times, and the places of
    all firings of the scan in this order, unless the scan has it."""

    parts: list[ScanPart]
    order: Int[Tensor, " a"]
    places: Int[Tensor, " a"] | None

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors, in a fixed order."""
        places = [] if self.places is None else [self.places]
        return [*(values for part in self.parts for values in part.tensors), self.order, *places]

    def joined(self, parts: Sequence[CompositedScan]) -> CompositedScan:
        """What the rays of the scan measure, by that of the parts."""
        whole = [torch.cat(values, dim=1) for values in zip(*parts, strict=True)]
        if self.places is None:
            return CompositedScan(*whole)
        return CompositedScan(*(_Permuted.apply(values, self.places, self.order) for values in whole))


class _Permuted(torch.autograd.Function):
    """The columns of an array at `places`, which are all columns in another order: its `inverse` gathers gradients,
    where torch, which does not know that no place occurs twice, sorts them."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, places: Tensor, inverse: Tensor) -> Tensor:
        ctx.save_for_backward(inverse)
        return values.index_select(1, places)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (inverse,) = ctx.saved_tensors
        return gradient.index_select(1, inverse), None, None


@dataclass(frozen=True)
class ScanMotion:
    """The motion during a revolution: of the sensor, with velocity `linear` (m/s) and angular velocity `angular`
    (rad/s), both in its own frame at the sweep's timestamp; and of Gaussians, with `velocities` (m/s) in world
    coordinates, unless None."""

    linear: Float[Tensor, "3"]
    angular: Float[Tensor, "3"]
    velocities: Float[Tensor, "n 3"] | None = None


@dataclass(frozen=True)
class ScanRendering:
    """What b beams and a firings measure.

    `range` is the expected range in metres, weighted with alpha and 0 where nothing is met. `median_range`, without
    gradient, is the range at which transmittance falls to 0.5, 0 where it does not. `values` are premultiplied by
    `alpha`. `alpha_before` is alpha of what is nearer than the given ranges, or None. `gaussians` are the projected
    Gaussians, with motion those of each half of the revolution; `retain_grad` of their `means2d` serves densification.
    """

    range: Float[Tensor, "b a"]
    median_range: Float[Tensor, "b a"]
    alpha: Float[Tensor, "b a"]
    values: Float[Tensor, "b a channels"]
    alpha_before: Float[Tensor, "b a"] | None
    gaussians: tuple[ScannedGaussians, ...]


def rasterize_scan(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    values: Float[Tensor, "n channels"],
    world_to_sensor: Float[Tensor, "4 4"],
    rays: RayGrid,
    *,
    beam_spread: tuple[float, float],
    motion: ScanMotion | None = None,
    before: Float[Tensor, "b a"] | None = None,
    max_range: float = MAX_RANGE,
) -> ScanRendering:
    """Renders n 3D Gaussians as a spinning LiDAR measures them.

    Projection and compositing follow SplatAD (CVPR 2025): Gaussians are linearised in azimuth, elevation and range, and
    composited front to back by the range of their centres. A ray meets a Gaussian at range + slopes · offset: on the
    plane of a flat Gaussian, within three standard deviations of the range in its footprint. Gaussians nearer than
    0.2 m, farther than `max_range`, or within 10° of the sensor's axis are skipped. The CPU composites in float32 or
    float64, in as many threads as torch uses and with results that do not depend on their number; a GPU in float32.
    Gradients reach the first six arguments.

    With `motion` a Gaussian is where it is when the beams pass its centre. All rays share that time, and gradients
    treat it as constant. The halves of the revolution are projected and composited separately: where it begins and
    ends, a Gaussian is at two places, and the rays of each time meet it at its own.

    Args:
        means: Centres in world coordinates, metres.
        quats: Rotations, Gaussian to world, as w, x, y, z of any length.
        scales: Standard deviations along the Gaussian's axes, metres.
        opacities: In [0, 1].
        values: Values of each channel.
        world_to_sensor: At the sweep's timestamp, metres; azimuths count from the sensor's x axis to its y axis,
            elevations from there to z.
        rays: Azimuths, elevations (radians) and times of b beams and a firings.
        beam_spread: Standard deviations of a beam's footprint in azimuth and elevation, radians.
        motion: Of the sensor and of the Gaussians during the revolution; None: `rays.offsets_s` have no effect.
        before: Ranges in metres: also render alpha of what is nearer.
        max_range: Gaussians beyond it (metres) are skipped.

    Returns:
        A `ScanRendering`: range, median_range, alpha and alpha_before (b, a); values (b, a, channels).

    Raises:
        ValueError: If there is no ray.

    Example:
        A Gaussian ten metres before the sensor and 2 m to its left, which the second of three beams meets.

        >>> import torch
        >>> from drivesplat.rasterization import RayGrid, rasterize_scan
        >>> means, scales = torch.tensor([[10.0, 2.0, 0.0]]), torch.full((1, 3), 0.1)
        >>> quats, opacities = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([0.8])
        >>> values = torch.tensor([[1.0, 0.0]])
        >>> azimuths = torch.atan2(means[:, 1], means[:, 0]).expand(3, 4)
        >>> elevations = torch.tensor([[-0.1], [0.0], [0.1]]).expand(3, 4)
        >>> rays = RayGrid(azimuths, elevations, torch.zeros(3, 4))
        >>> scan = rasterize_scan(
        ...     means, quats, scales, opacities, values, torch.eye(4), rays, beam_spread=(1e-3, 1e-3)
        ... )
        >>> [round(value, 3) for value in scan.range[:, 0].tolist()], [round(a, 3) for a in scan.alpha[:, 0].tolist()]
        ([0.0, 10.198, 0.0], [0.0, 0.8, 0.0])
        >>> tuple(scan.values.shape), bool((scan.values[..., 0] == scan.alpha).all())
        ((3, 4, 2), True)
    """
    if rays.azimuths.numel() == 0:
        raise ValueError(f"a scan needs rays; this one has {rays.azimuths.shape[0]} beams x {rays.azimuths.shape[1]}")
    revolutions, halves = None, None if motion is None else rays.halves
    if halves is not None:
        during = (motion.linear, motion.angular, motion.velocities)
        revolutions = [Revolution(part.firings, *during) for part in halves.parts]
    projected = scanned(means, quats, scales, opacities, world_to_sensor, revolutions, beam_spread, max_range)
    if halves is None:
        met = [MetPart(rays.whole, projected[0], before)]
        (composited,) = composite_scan(met, values)
    else:
        own = halves.order.split([part.azimuths.shape[1] for part in halves.parts])
        borders = [None if before is None else before[:, firings] for firings in own]
        met = [MetPart(*part) for part in zip(halves.parts, projected, borders, strict=True)]
        composited = halves.joined(composite_scan(met, values))
    range_sum, alpha, nearer, out, median = composited
    expected = range_sum / alpha.clamp(min=1e-10)
    gaussians_met = tuple(part.gaussians for part in met)
    return ScanRendering(expected, median, alpha, out, None if before is None else nearer, gaussians_met)
