"""Training with LiDAR scans: the recorded scans on the device, their order, and their loss."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from drivesplat.kernels.alpha_entropy import CERTAIN
from drivesplat.kernels.depth_error import KEPT_PERCENT
from drivesplat.lidar.sweeps import thin
from drivesplat.model.scans import ScanPicture, ScanView, view_of_scan
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scan_record import NO_OBJECT, RecordedScan
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import ScanTrainingSettings, TrainSettings
from drivesplat.training.losses import Means, regularization, weighted
from drivesplat.training.views import view_index

SCANS_SEED = 7919
"""Added to the training's random seed: the order of scans is another one than that of images."""
SPACING, NEAR_SEEDS = 0.2, 0.5
"""Edge in metres of the voxels that hold one seed point of scans each, and their least distance from other seeds."""


@dataclass(frozen=True)
class TrainingScan:
    """A recorded scan on the device: its view; which rays were `measured` and which `returned`; `range` in metres and
    `intensity` in [0, 1] of those that returned (None: the sensor records none)."""

    view: ScanView
    measured: Bool[Tensor, "b a"]
    returned: Bool[Tensor, "b a"]
    range: Float[Tensor, "b a"]
    intensity: Float[Tensor, "b a"] | None

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors that an iteration reads, in a fixed order."""
        intensity = [] if self.intensity is None else [self.intensity]
        return [*self.view.tensors, self.measured, self.returned, self.range, *intensity]


def load_scans(
    recorded: Sequence[RecordedScan], settings: ScanTrainingSettings, device: torch.device
) -> list[TrainingScan]:
    """Recorded scans on the device, without those of which no ray was measured."""
    spread = settings.beam_spread_rad
    return [_loaded(scan, spread, device) for scan in recorded if scan.measured.any()]


def _loaded(recorded: RecordedScan, spread: tuple[float, float], device: torch.device) -> TrainingScan:
    scan = recorded.scan
    measured, returned, ranges = (
        torch.from_numpy(values).to(device) for values in (recorded.measured, scan.returned, scan.ranges)
    )
    intensity = None if scan.intensities is None else torch.from_numpy(scan.intensities).to(device)
    return TrainingScan(view_of_scan(recorded, spread, device), measured, returned & measured, ranges, intensity)


def initial_lidar_logits(recorded: Sequence[RecordedScan]) -> tuple[float, float]:
    """The logits of the mean recorded intensity, and of the fraction of measured rays that returned; what meets a
    surface mostly returns."""
    intensities = [scan.scan.intensities[scan.scan.returned] for scan in recorded if scan.scan.intensities is not None]
    every = np.concatenate(intensities) if intensities else np.empty(0)
    return _logit(float(every.mean()) if len(every) else 0.5), _logit(0.9)


def with_scan_points(
    record: TrainingRecord, recorded: Sequence[RecordedScan], settings: ScanTrainingSettings, seed: int
) -> TrainingRecord:
    """A training record with seed points of static surfaces that scans met and no other seed point is near, in the mean
    colour of the others: cameras did not see most of them."""
    returns = [scan.points()[scan.objects_met == NO_OBJECT] for scan in recorded]
    points = np.concatenate([np.empty((0, 3)), *returns])
    points = points[thin(points, SPACING)]
    if len(record.points) and len(points):
        points = points[cKDTree(record.points).query(points, workers=-1)[0] > NEAR_SEEDS]
    if len(points) > settings.points:
        points = points[np.sort(np.random.default_rng(seed).choice(len(points), settings.points, replace=False))]
    color = record.points_rgb.mean(axis=0).round() if len(record.points_rgb) else np.full(3, 128.0)
    colors = np.tile(color.astype(np.uint8), (len(points), 1))
    return dataclasses.replace(
        record,
        points=np.concatenate([record.points, points.astype(record.points.dtype)]),
        points_rgb=np.concatenate([record.points_rgb, colors]),
    )


def _logit(probability: float) -> float:
    within = min(max(probability, 0.01), 0.99)
    return math.log(within / (1.0 - within))


def scan_index(count: int, scans_before: int, seed: int) -> int:
    """The index of the scan of an iteration, after so many that fitted scans: a new seeded permutation every epoch."""
    return view_index(count, scans_before, seed + SCANS_SEED)


def scan_terms(
    picture: ScanPicture, scan: TrainingScan, model: SplatModel, settings: TrainSettings
) -> dict[str, Float[Tensor, ""]]:
    """The weighted terms of the loss of a scan; rays that were not measured have no effect."""
    weights = settings.scans
    returned = scan.returned.float()
    count = returned.sum().clamp(min=1.0)
    certain, measured = picture.returned.clamp(CERTAIN, 1.0 - CERTAIN), scan.measured.float()
    likelihood = torch.where(scan.returned, certain, 1.0 - certain)
    terms: Means = {
        "scan_range": (weights.range_weight, range_loss(picture.range, picture.alpha, scan)),
        "scan_drop": (-weights.drop_weight, (likelihood.log() * measured).sum() / measured.sum().clamp(min=1.0)),
    }
    if scan.intensity is not None:
        errors = (picture.intensity - scan.intensity).square()
        terms["scan_intensity"] = weights.intensity_weight, (errors * returned).sum() / count
    if picture.alpha_before is not None:
        terms["scan_sight"] = weights.sight_weight, (picture.alpha_before * returned).sum() / count
    return weighted({**terms, **regularization(picture, model, settings)})


def range_loss(expected: Float[Tensor, "b a"], alpha: Float[Tensor, "b a"], scan: TrainingScan) -> Float[Tensor, ""]:
    """Mean absolute error of the ranges of returns in metres, without the largest 5 % (SplatAD): rays that graze an
    edge. A ray that meets nothing has none."""
    met = scan.returned & (alpha > CERTAIN)
    errors = torch.where(met, (expected - scan.range).abs(), 0.0)
    with torch.no_grad():
        ascending = errors.masked_fill(~met, torch.inf).flatten().sort().values
        last = (KEPT_PERCENT / 100 * (met.sum().double() - 1.0)).clamp(min=0.0).long()
        kept = met & (errors <= ascending.gather(0, last[None]))
    return (errors * kept).sum() / kept.sum().clamp(min=1)
