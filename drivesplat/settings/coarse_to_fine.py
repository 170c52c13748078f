"""The settings of trainings that begin coarse."""

from pydantic import Field

from drivesplat.settings import Settings


class CoarseToFineSettings(Settings):
    """Reduced images at first: an iteration costs less, and what is large is found before what is small (after
    DashGaussian, Chen et al. 2025, arXiv 2503.18402)."""

    quarter_until: float = Field(0.0, ge=0, le=1)
    """Until this fraction of the iterations images are reduced to a quarter of their width and height."""
    half_until: float = Field(0.0, ge=0, le=1)
    """From then on, until this fraction, to a half."""
