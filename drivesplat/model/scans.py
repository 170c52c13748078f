"""A LiDAR's revolution as a model sees it: a view of rays, and the scan that Gaussians give."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.kernels.view_colors import lidar_response
from drivesplat.model.gaussians import Gaussians, GaussianSets
from drivesplat.model.groups import NOTHING, strongest_group
from drivesplat.model.view import inverse
from drivesplat.rasterization.scans import RayGrid, ScanMotion, ScanRendering, rasterize_scan
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import RecordedScan

WITHOUT_LIDAR = (
    "the model was trained without LiDAR: take a method such as street_lidar, "
    "or train it with train.scans.per_image above 0"
)


@dataclass(frozen=True)
class ScanView:
    """A revolution of a LiDAR at a `time` in seconds since the first image: the sensor's pose (metres) then, its rays
    at their own times, its velocities (m/s, rad/s) in its own frame, the standard deviations of a beam's footprint in
    azimuth and elevation (radians), and the rays that the vehicle blocks (None: none), which do not return."""

    sensor_to_world: Float[Tensor, "4 4"]
    rays: RayGrid
    linear: Float[Tensor, "3"]
    angular: Float[Tensor, "3"]
    time: float
    beam_spread: tuple[float, float]
    blocked: Bool[Tensor, "b a"] | None = None

    @property
    def world_to_sensor(self) -> Float[Tensor, "4 4"]:
        return inverse(self.sensor_to_world)

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors that a rendering reads, in a fixed order."""
        blocked = [] if self.blocked is None else [self.blocked]
        return [self.sensor_to_world, self.linear, self.angular, *self.rays.tensors, *blocked]


@dataclass(frozen=True)
class ScanPicture:
    """What b beams and a firings measure of `sets` of Gaussians: `range` in metres, 0 where nothing is met; `returned`,
    the probability of a return; `intensity` in [0, 1]; `alpha`, of all that is met, and `alpha_before`, of what is
    nearer than given ranges (None: none were given)."""

    sets: GaussianSets
    range: Float[Tensor, "b a"]
    returned: Float[Tensor, "b a"]
    intensity: Float[Tensor, "b a"]
    alpha: Float[Tensor, "b a"]
    alpha_before: Float[Tensor, "b a"] | None

    def copied(self) -> "ScanPicture":
        """A copy of what the rays measure in memory of its own."""
        tensors = (self.range, self.returned, self.intensity, self.alpha)
        before = None if self.alpha_before is None else self.alpha_before.clone()
        return ScanPicture(self.sets, *(values.clone() for values in tensors), before)

    def rendered(self) -> RenderedScan:
        """The same as arrays."""
        tensors = (self.range, 1.0 - self.returned, self.intensity)
        return RenderedScan(*(values.detach().cpu().numpy() for values in tensors))


def view_of_scan(
    recorded: RecordedScan, beam_spread: tuple[float, float], device: torch.device, rays: RayGrid | None = None
) -> ScanView:
    """A recorded scan as a view. `beam_spread` in radians; `rays`, where they are known, are those of the scan."""
    arrays = recorded.sensor_to_world, recorded.linear, recorded.angular
    pose, linear, angular = (torch.from_numpy(array).float().to(device) for array in arrays)
    blocked = torch.from_numpy(recorded.blocked).to(device) if recorded.blocked.any() else None
    rays = rays or RayGrid.of(recorded.scan.rays, pose)
    return ScanView(pose, rays, linear, angular, recorded.seconds, beam_spread, blocked)


def scan_picture(sets: GaussianSets, view: ScanView, before: Float[Tensor, "b a"] | None = None) -> ScanPicture:
    """The scan of sets of Gaussians with `lidar_logits`; with `alpha_before` the ranges `before` (metres). A ray that
    meets nothing, or that the vehicle blocks, is not returned. Raises ResultError for Gaussians without these logits.
    """
    values, sensor = [], view.sensor_to_world[:3, 3]
    for own in sets:  # two values of each Gaussian are concatenated, not its eight coefficients
        if own.lidar_logits is None:
            raise ResultError(WITHOUT_LIDAR)
        values.append(lidar_response(own.lidar_logits, own.means, sensor))
    rendering = composited_scan(sets.shapes, view, torch.cat(values), before)
    intensity, returned = rendering.values.unbind(dim=-1)
    if view.blocked is not None:
        returned = torch.where(view.blocked, 0.0, returned)
    met = rendering.alpha.clamp(min=NOTHING)
    nearer = rendering.alpha_before
    return ScanPicture(sets, rendering.range, returned, intensity / met, rendering.alpha, nearer)


def group_met(gaussians: Gaussians, view: ScanView, groups: Int[Tensor, " n"]) -> Int[Tensor, "b a"]:
    """The one of `groups`, numbers from -1, whose Gaussians contribute most to each ray; -1 where nothing is met."""
    return strongest_group(groups, lambda shares: composited_scan(gaussians, view, shares.to(gaussians.means)).values)


def composited_scan(
    gaussians: Gaussians, view: ScanView, values: Float[Tensor, "n v"], before: Float[Tensor, "b a"] | None = None
) -> ScanRendering:
    """`values` of Gaussians along the rays of a scan; with `alpha_before` the ranges `before` (metres)."""
    return rasterize_scan(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, values,
        view.world_to_sensor, view.rays, beam_spread=view.beam_spread,
        motion=ScanMotion(view.linear, view.angular, gaussians.velocities), before=before,
    )  # fmt: skip
