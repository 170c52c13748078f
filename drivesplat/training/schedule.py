"""The schedule of a training: the only place that counts its steps."""

from dataclasses import dataclass

from drivesplat.settings.train import TrainSettings


@dataclass(frozen=True)
class Schedule:
    """What each step of a training does, and how far the training has come by then.

    A step fits one image or one LiDAR scan. `train.iterations` counts the steps that fit an image; without `images`,
    where every step fits a scan, it counts all. Of the first `fine_tuning_from` steps, `scans` fit a scan, evenly
    spread among those that fit an image. After them `fine_tuning` steps fit scans and fine-tune what only the LiDAR
    sees. Fractions of a training, as settings name them, are fractions of the first `fine_tuning_from` steps.
    """

    settings: TrainSettings
    fine_tuning_from: int
    scans: int = 0
    fine_tuning: int = 0
    images: bool = True

    @classmethod
    def of(cls, settings: TrainSettings, images: int, scans: int = 0) -> "Schedule":
        """The schedule of a training with so many images and scans. Without images nothing is fine-tuned: scans may
        change all Gaussians."""
        count, of_scans = settings.iterations, settings.scans
        if not scans or not of_scans.per_image:
            return cls(settings, count)
        if not images:
            return cls(settings, count, count, images=False)
        beside = round(of_scans.per_image * count)
        return cls(settings, count + beside, beside, round(of_scans.fine_tune * count))

    @property
    def steps(self) -> int:
        return self.fine_tuning_from + self.fine_tuning

    def fits_scan(self, step: int) -> bool:
        return self.scans_before(step + 1) > self.scans_before(step)

    def scans_before(self, step: int) -> int:
        """The number of the first `step` steps that fit a scan; beyond the last step none does, unless there are no
        images."""
        if not self.images:
            return step
        beside_images = min(step, self.fine_tuning_from) * self.scans // self.fine_tuning_from
        return beside_images + min(max(0, step - self.fine_tuning_from), self.fine_tuning)

    def images_before(self, step: int) -> int:
        """The number of the first `step` steps that fit an image."""
        return step - self.scans_before(step)

    def iterations_before(self, step: int) -> int:
        """The number of the first `step` steps that `train.iterations` counts."""
        return self.images_before(step) if self.images else step

    def fine_tunes(self, step: int) -> bool:
        """Whether a step fine-tunes what only the LiDAR sees: it fits a scan and changes no image."""
        return self.fine_tuning_from <= step < self.steps

    def fine_tuned(self, step: int) -> float:
        """The fraction of the fine-tuning that is done before one of its steps."""
        return (step - self.fine_tuning_from) / self.fine_tuning

    def progress(self, step: int) -> float:
        """The fraction of the training that is done before a step."""
        return step / self.fine_tuning_from

    def step_at(self, fraction: float) -> int:
        """The step before which a fraction of the training is done."""
        return int(fraction * self.fine_tuning_from)

    def sh_degree(self, step: int, highest: int) -> int:
        """The degree up to which a step renders spherical harmonics; it grows to the `highest` of a model."""
        return min(step // max(1, self.step_at(self.settings.sh_every)), highest)

    def reduction(self, step: int, rows: int) -> int:
        """The factor by which width and height of images are reduced at a step, the smallest of which has so many
        `rows`."""
        done, coarse = self.progress(step), self.settings.coarse_to_fine
        wanted = 4 if done < coarse.quarter_until else 2 if done < coarse.half_until else 1
        return next((factor for factor in (4, 2) if factor <= wanted and rows >= factor * coarse.min_height), 1)
