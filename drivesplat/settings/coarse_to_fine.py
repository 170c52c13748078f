"""The settings of trainings that begin coarse."""

from pydantic import Field

from drivesplat.settings import Settings


class CoarseToFineSettings(Settings):
    """Reduced images and fewer Gaussians at first: an iteration costs less, and what is large is found before what is
    small (after DashGaussian, Chen et al. 2025, arXiv 2503.18402)."""

    quarter_until: float = Field(0.2, ge=0, le=1)
    """Until this fraction of the iterations images are reduced to a quarter of their width and height."""
    half_until: float = Field(0.7, ge=0, le=1)
    """From then on, until this fraction, to a half."""
    least_height: int = Field(225, ge=16)
    """Pixels: no image is reduced to fewer rows. 900 rows are reduced to 225, 640x360 images are not reduced."""
    share: float = Field(0.6, gt=0, le=1)
    """While images are reduced, with strategy: mcmc, the number of Gaussians grows to no more than this share of what
    there may be; it is given up in time for them to grow to all before densification stops."""
