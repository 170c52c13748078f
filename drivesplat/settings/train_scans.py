"""Settings of the LiDAR in a training."""

from typing import Annotated

from pydantic import Field

from drivesplat.settings import Settings

Milliradians = Annotated[float, Field(ge=0, le=20)]


class ScanTrainingSettings(Settings):
    """Rendered LiDAR: Gaussians with an intensity and a probability to return a ray, fitted to recorded scans. Needs
    strategy: mcmc. Defaults of the weights are those of SplatAD (Hess et al. 2025, arXiv 2411.16816)."""

    per_image: float = Field(0.0, ge=0, le=10)
    """Iterations that fit a scan, per iteration that fits an image, in addition to these and evenly spread among them.
    0 = LiDAR is not rendered. Without cameras each of `train.iterations` fits a scan where it is above 0."""
    geometry: float = Field(1.0, ge=0, le=1)
    """Factor of the gradient by which scans move and shape Gaussians. 0 = they fit intensities and returns alone, and
    images are rendered as without LiDAR."""
    fine_tune: float = Field(0.0, ge=0, le=10)
    """Further iterations that fit scans and change no image, per iteration that fits an image: they fit offsets of
    position, rotation, size and opacity of background Gaussians that only the LiDAR sees, intensities and returns.
    Densification and all schedules of images end before them. 0 = no such offsets."""
    range_weight: float = Field(0.1, ge=0)
    """Loss weight of the mean absolute error of ranges (metres), without the worst 5 % of the rays."""
    intensity_weight: float = Field(1.0, ge=0)
    """Loss weight of the mean squared error of intensities, in [0, 1]."""
    drop_weight: float = Field(0.1, ge=0)
    """Loss weight of the binary cross entropy between the probability of a return and whether there is one."""
    sight_weight: float = Field(0.1, ge=0)
    """Loss weight of the mean alpha of what is nearer than a return by `sight_margin`: a ray that returns has passed
    empty space."""
    sight_margin: float = Field(0.8, ge=0, le=10)
    """Distance before a return (metres) that need not be empty."""
    points: int = Field(100_000, ge=0, le=5_000_000)
    """Maximum number of seed points from training scans, where no camera saw a surface: a LiDAR looks all around. The
    limits on the number of Gaussians rise by their number. 0 = none."""
    beam_spread: tuple[Milliradians, Milliradians] = (0.3, 0.3)
    """Standard deviation of a beam's footprint in azimuth and elevation (milliradians)."""

    @property
    def beam_spread_rad(self) -> tuple[float, float]:
        """`beam_spread` in radians."""
        azimuth, elevation = self.beam_spread
        return 1e-3 * azimuth, 1e-3 * elevation
