"""How far a LiDAR scan from off the recorded path can be trusted: the range error that it would have beside a recorded
scan, and a validity from 0 to 1.

What a scan gets wrong beside the path is above all what it measures from nearer than any training scan did:

    error = e (1 + a mean(sqrt(magnification - 1)))

e is the median range error of the training scans. `magnification` is the distance from which the nearest training scan
that saw a surface saw it, divided by the distance to the scan's own sensor, from 1 to MAX_MAGNIFICATION, which also
holds for what none saw. The mean is over the rays that return. `a`, how fast a drive gets worse between its training
scans, is fitted to the range errors of its own held-out scans, which eval.json states. The form, DEFAULT_GROWTH and
RESIDUALS were fitted to the drive of the demo (docs/closed_loop.md). Two terms that the error of images has were left
out, since they put the demo's scans into a worse order: the range errors of single Gaussians in training scans, and the
angles between directions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.drive.drive_view import DriveScan
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.drive.world_state import WorldState
from drivesplat.errors import RequestError
from drivesplat.evaluation.scan_metrics import ScanPool
from drivesplat.model.gaussians import Gaussians, concatenate_shapes
from drivesplat.model.scans import ScanView, composited_scan, view_of_scan
from drivesplat.model.states import SCAN
from drivesplat.rasterization.scans import RayGrid
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.simulate.held_out import GROUPS, GROWTHS, held_out_figures
from drivesplat.simulate.seen_from import (
    SeenActor,
    SeenGaussians,
    evenly_chosen,
    seen_assets_of,
    sides_of_objects,
    sides_of_parts,
)
from drivesplat.training.unseen import MIN_WEIGHT

MAX_RAYS = 8192
"""Rays of a scan for which the validity is computed: of larger scans every so many firings."""
MIN_RAYS = 1.0
"""Sum of the weights in the rays of a training scan that an object's Gaussians need for the scan to have seen it."""
MAX_MAGNIFICATION = 4.0
"""The largest magnification that counts, and that of what no training scan saw."""
DEFAULT_GROWTH = 1.7
"""`a` where held-out scans do not tell: that of the demo's drive."""
RESIDUALS = (0.5, 2.4)
"""True divided by expected errors: the 5 % quantile of another street, trained ten times as long, and the 95 % quantile
of the demo's to the power of 1.5."""


@dataclass(frozen=True)
class ScanValidity:
    """How far a scan can be trusted.

    `distance` (metres) is that to the nearest place of the sensor in a training scan. `supported`, `unseen` and
    `turned` are shares of the rays that return. `supported`: surfaces that two training scans saw from within 20
    degrees and from at most twice the distance. `unseen`: static Gaussians that no training scan saw. `turned`: objects
    that show a side that no training scan saw, which is farther round than 40 degrees. What is neither was seen from
    another direction or from farther away.

    `expected_range_error` (metres) is the median of the absolute error of range, beside a scan that the sensor would
    have recorded, over the rays that return in both; `interval` (metres) is where 90 % of the scans of the calibration
    lie about it. Both are None for a scan without returns.

    `validity` is the error that is expected of held-out scans on the path, divided by that of this scan, at most 1,
    multiplied by the share of the rays that meet what training scans saw: 1 is as good as held-out scans, 0.5 has twice
    the error or half of it never seen, 0 has no return of anything that was ever seen.
    """

    distance: float
    supported: float
    unseen: float
    turned: float
    expected_range_error: float | None
    interval: tuple[float, float] | None
    validity: float


@dataclass(frozen=True)
class _RayMeans:
    """Means over the rays of a scan that return: shares of `ScanValidity`, and `nearer`, sqrt(magnification - 1)."""

    supported: float
    unseen: float
    turned: float
    nearer: float


@dataclass(frozen=True, eq=False)
class ScanKnowledge:
    """What the training scans of a `drive` tell of scans from other places: what they saw of its `gaussians` and
    `objects`; their median range error (`error`, metres), its `growth` (`a`), and the error that is expected of
    held-out scans on the path (`reference`, metres)."""

    drive: TrainedDrive
    gaussians: SeenGaussians
    objects: dict[str, SeenActor]
    error: float
    growth: float
    reference: float

    @classmethod
    def of_drive(cls, drive: TrainedDrive) -> "ScanKnowledge":
        """Renders all training scans once, and compares them with the recorded ones. Then it fits the growth to the
        held-out scans of eval.json beside the model; without this file DEFAULT_GROWTH holds. Where no scan is held out,
        training scans are the reference.

        Raises RequestError for a drive without rendered LiDAR or without training scans, ResultError for an invalid
        eval.json.

        >>> drive = drivesplat.open("results/demo/street_lidar")
        >>> known, world = ScanKnowledge.of_drive(drive), drive.state(4.2)
        >>> known.validity(world, world.scan(drive.lidars[0])).validity
        """
        if not drive.renders_lidar:
            raise RequestError(
                f"{drive.where} renders no LiDAR, so that there are no scans to trust: take a method that was trained "
                "with train.scans.per_image above 0"
            )
        scans = evenly_chosen(drive.recording.scans.of_group("train"))
        known = cls(drive, *seen_by_scans(drive, scans), DEFAULT_GROWTH, math.nan) if scans else None
        if known is None or math.isnan(known.error):
            raise RequestError(
                f"{drive.where} has no training scan with returns, so that nothing tells how far others can be trusted"
            )
        return known._fitted(scans)

    @torch.no_grad()
    def validity(self, world: WorldState, scan: DriveScan) -> ScanValidity:
        """How far a scan of a world of this drive can be trusted.

        Raises RequestError for a world of another drive.
        """
        view = view_of_scan(scan.sensor, self.drive.beam_spread, self.drive.device)
        distance = float((self.gaussians.centers - view.sensor_to_world[:3, 3]).norm(dim=1).min())
        means = self._means(world, view, scan.returned)
        if means is None:
            return ScanValidity(distance, 0.0, 0.0, 0.0, None, None, 0.0)
        error, known = self._expected(means), max(0.0, 1.0 - means.unseen - means.turned)
        interval = (error * RESIDUALS[0], error * RESIDUALS[1])
        validity = known * min(1.0, self.reference / error)
        return ScanValidity(distance, means.supported, means.unseen, means.turned, error, interval, validity)

    def _expected(self, means: _RayMeans) -> float:
        return self.error * (1.0 + self.growth * means.nearer)

    def _means(self, world: WorldState, view: ScanView, returned: Bool[Tensor, "b a"]) -> _RayMeans | None:
        """The means over the rays that return, of at most MAX_RAYS rays; None where none does."""
        every = math.ceil(returned.numel() / MAX_RAYS)
        counted = returned[:, ::every]
        if not bool(counted.any()):
            return None
        small = replace(view, rays=RayGrid(*(values[:, ::every] for values in view.rays.rays)), blocked=None)
        placed, place, values = world.placed(), view.sensor_to_world[:3, 3], []
        sets = placed.sets_in(small)
        of_objects = sides_of_objects(self.objects, list(world.actors.values()), place, 1.0)
        shown = [torch.arange(len(own), device=place.device) for own in sets]
        one = place.new_ones(())
        parts = sides_of_parts(self.drive.model, self.gaussians, of_objects, placed, sets, shown, place, one)
        for has_objects, _, sides in parts:
            lost = sides.unseen if has_objects else sides.magnification.isinf()
            magnification = torch.where(lost, MAX_MAGNIFICATION, sides.magnification.clamp(1.0, MAX_MAGNIFICATION))
            unseen, nothing = lost.float(), torch.zeros_like(magnification)
            of_kind = (nothing, unseen) if has_objects else (unseen, nothing)
            supported = (sides.similar & ~lost).float()
            values.append(torch.stack([supported, *of_kind, (magnification - 1.0).sqrt()], dim=1))
        found = composited_scan(concatenate_shapes(sets), small, torch.cat(values))
        of_rays = found.values[counted] / found.alpha[counted].clamp(min=1e-6)[:, None]
        return _RayMeans(*of_rays.mean(dim=0).tolist())

    @torch.no_grad()
    def _means_of_scan(self, scan: RecordedScan) -> _RayMeans | None:
        """The means of the rays of a recorded scan of the drive as recorded."""
        drive = self.drive if self.drive.before is None else self.drive.before
        world, view = drive.state(scan.seconds, outside="clamp"), view_of_scan(scan, drive.beam_spread, drive.device)
        rendered = world.placed().scan(view).rendered()
        return self._means(world, view, torch.from_numpy(rendered.returned & scan.measured).to(drive.device))

    def _fitted(self, training: Sequence[RecordedScan]) -> "ScanKnowledge":
        """With the growth by which the mean error of held-out scans is as it was measured; with another level of
        errors where none within limits does that; and with the reference."""
        figures = held_out_figures(self.drive.folder, "lidar", "all", "range_error_median_m")
        means = {name: self._of_scans(self.drive.recording.scans.of_group(name)) for name in figures}
        groups = [(figures[name], own) for name, own in means.items() if own]
        fitted, near = self, means.get(GROUPS[0]) or [one for _, own in groups for one in own]
        if groups:
            count = sum(len(own) for _, own in groups)
            measured = sum(len(own) * error for error, own in groups) / count
            nearer = sum(one.nearer for _, own in groups for one in own) / count
            growth = (measured / self.error - 1.0) / max(nearer, 1e-6)
            fitted = replace(self, growth=min(max(growth, GROWTHS[0]), GROWTHS[1]))
            level = measured / (fitted.error * (1.0 + fitted.growth * nearer))
            fitted = replace(fitted, error=level * fitted.error)
        logs = [math.log(fitted._expected(one)) for one in near or self._of_scans(training)]
        return replace(fitted, reference=math.exp(sum(logs) / len(logs)) if logs else fitted.error)

    def _of_scans(self, scans: Sequence[RecordedScan]) -> list[_RayMeans]:
        found = (self._means_of_scan(scan) for scan in evenly_chosen(scans))
        return [means for means in found if means is not None]


@torch.no_grad()
def seen_by_scans(
    drive: TrainedDrive, scans: Sequence[RecordedScan]
) -> tuple[SeenGaussians, dict[str, SeenActor], float]:
    """What these training scans saw of the static Gaussians and of the objects of the drive as recorded, and the median
    of their range errors (metres), over rays that return in both scans; nan where none does.

    A scan saw a Gaussian whose weights in its measured rays sum to MIN_WEIGHT rays, and an object whose Gaussians have
    MIN_RAYS rays.
    """
    model, actors = drive.model, (drive if drive.before is None else drive.before).edited_actors
    rows = [(actor, own) for actor in actors if (own := model.of_track(actor.id)) is not None]
    pool, seen, met = ScanPool(chamfer=False), [], []
    views = [view_of_scan(scan, drive.beam_spread, drive.device) for scan in scans]
    for scan, view in zip(scans, views, strict=True):
        gaussians = model.at(view.time, SCAN)
        pool.add(scan, model.scan(view, gaussians=gaussians).rendered(), scan.measured)
        weights = _weights(gaussians, view, torch.from_numpy(scan.measured).to(drive.device).float())
        seen.append(weights >= MIN_WEIGHT)
        met.append([bool(weights[own].sum() >= MIN_RAYS) for _, own in rows])
    centers = torch.stack([view.sensor_to_world[:3, 3] for view in views])
    seen_by = np.array(met, dtype=bool).reshape(len(scans), len(rows))
    seconds, poses = np.array([scan.seconds for scan in scans]), np.stack([scan.sensor_to_world for scan in scans])
    objects = {}
    for number, (actor, _) in enumerate(rows):
        by = seen_by[:, number] & actor.present(seconds)
        beside = (inverse(actor.poses(seconds[by])) @ poses[by][:, :, 3:])[:, :3, 0]
        azimuths, distances = np.arctan2(beside[:, 1], beside[:, 0]), np.linalg.norm(beside, axis=1)
        objects[actor.id] = SeenActor(azimuths, 1.0 / np.maximum(distances, 1e-6))
    errors = np.concatenate(pool.errors)
    gaussians = SeenGaussians(torch.stack(seen, dim=1), centers, torch.ones_like(centers[:, 0]), None)
    return (
        gaussians,
        objects | seen_assets_of(drive.edited_actors),
        float(np.median(errors)) if len(errors) else math.nan,
    )


def _weights(gaussians: Gaussians, view: ScanView, rays: Float[Tensor, "b a"]) -> Float[Tensor, " n"]:
    """The weights of each Gaussian in the rays, multiplied by `rays` and summed: the gradient of a scan by values of
    Gaussians are their weights."""
    values = gaussians.means.new_zeros(len(gaussians), 2).requires_grad_()  # two, as intensities and returns have
    with torch.enable_grad():
        shown = composited_scan(gaussians, view, values).values[..., 0]
        return torch.autograd.grad((shown * rays).sum(), values)[0][:, 0]
