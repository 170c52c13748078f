"""Which iterations of a training fit LiDAR scans in place of images."""

import math
from dataclasses import dataclass

from drivesplat.settings.train import TrainSettings


@dataclass(frozen=True)
class ScanSchedule:
    """Of so many `iterations`, `share` of those before `fine_tuning_from` fit a scan, evenly spread; from there on all
    do, and these fine-tune what only the LiDAR sees."""

    iterations: int
    share: float
    fine_tuning_from: int

    @classmethod
    def of(cls, settings: TrainSettings, images: int, scans: int) -> "ScanSchedule":
        """The schedule of a training with so many images and scans. Without images nothing is fine-tuned: scans may
        change all Gaussians."""
        if not scans or not settings.scans.share:
            return cls(settings.iterations, 0.0, settings.iterations)
        fine_tuning = int(settings.scans.fine_tune * settings.iterations) if images else 0
        return cls(settings.iterations, settings.scans.share, settings.iterations - fine_tuning)

    def fine_tunes(self, step: int) -> bool:
        """Whether an iteration fine-tunes what only the LiDAR sees."""
        return self.fine_tuning_from <= step < self.iterations

    def fine_tuned(self, step: int) -> float:
        """The fraction of the fine-tuning that is done before an iteration of it."""
        return (step - self.fine_tuning_from) / (self.iterations - self.fine_tuning_from)

    def fits_scan(self, step: int) -> bool:
        """Whether an iteration fits a scan."""
        return self.scans_before(step + 1) > self.scans_before(step)

    def scans_before(self, step: int) -> int:
        """The number of the first `step` iterations that fit a scan."""
        return math.floor(min(step, self.fine_tuning_from) * self.share) + max(0, step - self.fine_tuning_from)

    def images_before(self, step: int) -> int:
        """The number of the first `step` iterations that fit an image."""
        return step - self.scans_before(step)
