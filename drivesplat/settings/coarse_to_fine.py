"""Settings of a training that begins with reduced images and fewer Gaussians."""

from pydantic import Field

from drivesplat.settings import Settings


class CoarseToFineSettings(Settings):
    """Trains with reduced images and fewer Gaussians at first, so that early iterations are faster (after DashGaussian,
    Chen et al. 2025, arXiv 2503.18402)."""

    quarter_until: float = Field(0.2, ge=0, le=1)
    """Fraction of the iterations that use images of a quarter of the width and height."""
    half_until: float = Field(0.7, ge=0, le=1)
    """Fraction of the iterations after which images have full size. Before it they have half the width and height."""
    min_height: int = Field(225, ge=16)
    """Minimum number of rows of a reduced image. 900 rows are reduced to 225; images of 640x360 are not reduced."""
    fraction: float = Field(0.6, gt=0, le=1)
    """Fraction of the Gaussian limit that applies while images are reduced, with strategy: mcmc. The full limit
    applies early enough for the number of Gaussians to reach it before densification stops."""
