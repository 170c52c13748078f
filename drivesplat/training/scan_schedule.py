"""Which iterations of a training fit LiDAR scans, beside those that fit images."""

from dataclasses import dataclass

from drivesplat.settings.train import TrainSettings


@dataclass(frozen=True)
class ScanSchedule:
    """Of the first `fine_tuning_from` iterations, `scans` fit a scan, evenly spread among those that fit an image;
    after them `fine_tuning` iterations fit scans and fine-tune what only the LiDAR sees. Without `images` every
    iteration fits a scan."""

    fine_tuning_from: int
    scans: int
    fine_tuning: int
    images: bool = True

    @classmethod
    def of(cls, settings: TrainSettings, images: int, scans: int) -> "ScanSchedule":
        """The schedule of a training with so many images and scans. Without images nothing is fine-tuned: scans may
        change all Gaussians."""
        count, of_scans = settings.iterations, settings.scans
        if not scans or not of_scans.per_image:
            return cls(count, 0, 0)
        if not images:
            return cls(count, count, 0, images=False)
        beside = round(of_scans.per_image * count)
        return cls(count + beside, beside, round(of_scans.fine_tune * count))

    @property
    def steps(self) -> int:
        """The number of all iterations."""
        return self.fine_tuning_from + self.fine_tuning

    def fine_tunes(self, step: int) -> bool:
        """Whether an iteration fine-tunes what only the LiDAR sees."""
        return self.fine_tuning_from <= step < self.steps

    def fine_tuned(self, step: int) -> float:
        """The fraction of the fine-tuning that is done before an iteration of it."""
        return (step - self.fine_tuning_from) / self.fine_tuning

    def fits_scan(self, step: int) -> bool:
        """Whether an iteration fits a scan."""
        return self.scans_before(step + 1) > self.scans_before(step)

    def scans_before(self, step: int) -> int:
        """The number of the first `step` iterations that fit a scan; beyond the last iteration none does, unless there
        are no images."""
        if not self.images:
            return step
        beside_images = min(step, self.fine_tuning_from) * self.scans // self.fine_tuning_from
        return beside_images + min(max(0, step - self.fine_tuning_from), self.fine_tuning)

    def images_before(self, step: int) -> int:
        """The number of the first `step` iterations that fit an image."""
        return step - self.scans_before(step)

    def counted_before(self, step: int) -> int:
        """The number of the first `step` iterations that `train.iterations` counts: those with an image; without images
        all."""
        return self.images_before(step) if self.images else step
