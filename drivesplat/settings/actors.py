"""Training settings of actors: Gaussians in the frames of moving boxes."""

from pydantic import Field

from drivesplat.settings import Settings


class TrackSettings(Settings):
    """Learned corrections of the annotated poses of actors. Poses between annotations are interpolated smoothly."""

    corrected: bool = True
    """Correct annotated positions and headings."""
    lr_translation: float = Field(1e-3, gt=0)
    """Learning rate of the position corrections (metres)."""
    lr_yaw: float = Field(5e-4, gt=0)
    """Learning rate of the heading corrections (radians)."""
    size_weight: float = Field(0.001, ge=0)
    """Loss weight of the mean square of the corrections, in units of `sigma_translation` and `sigma_yaw`."""
    bend_weight: float = Field(0.001, ge=0)
    """Loss weight of the mean square of their second differences along a track, in the same units. It keeps corrections
    smooth, so that they hold for the held-out frames in between (docs/street.md)."""
    sigma_translation: float = Field(0.1, gt=0)
    """Expected error of an annotated position (metres)."""
    sigma_yaw: float = Field(0.03, gt=0)
    """Expected error of an annotated heading (radians)."""


class ActorSettings(Settings):
    """The part `actors`: moving vehicles, each a set of Gaussians in the frame of its box."""

    cap_max: int = Field(200_000, ge=1, le=20_000_000)
    """Maximum number of Gaussians of all actors together. Each actor keeps at least four."""
    least: int = Field(500, ge=1)
    """Number of Gaussians that every actor may have. Beyond it, train.pixels_per_gaussian limits an actor by the number
    of training pixels in its box."""
    sh_degree: int = Field(1, ge=0, le=3)
    """Degree of the spherical harmonics of their colours, in the object's frame."""
    fourier: int = Field(5, ge=1, le=16)
    """Number of Fourier coefficients over time of every colour coefficient. 1 = colours constant in time."""
    box_margin: float = Field(0.1, ge=0, le=2)
    """Gaussians with centres farther than this (metres) outside their box are faded out."""
    tracks: TrackSettings = TrackSettings()
