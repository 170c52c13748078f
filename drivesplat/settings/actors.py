"""How the actors of a training learn: Gaussians in the frames of moving boxes."""

from pydantic import Field

from drivesplat.settings import Settings


class TrackSettings(Settings):
    """Learned corrections of where actors are at their annotations, between which they are interpolated smoothly."""

    corrected: bool = True
    """Whether annotated positions and headings are corrected at all."""
    lr_translation: float = Field(1e-3, gt=0)
    """Learning rate of the corrections of position (metres)."""
    lr_yaw: float = Field(5e-4, gt=0)
    """Learning rate of the corrections of heading (radians)."""
    size_weight: float = Field(0.001, ge=0)
    """Weight of the mean square of the corrections, in units of `sigma`s: annotations are trusted so far."""
    bend_weight: float = Field(0.001, ge=0)
    """Weight of the mean square of their second differences, in the same units: corrections change slowly, and carry
    over to the held-out frames between. On scene 0061 what moves measures 25.1 dB with it, held out, 22 dB with a
    hundred times as much, which allows no correction, and 20 dB with none, which lets them fit one image each."""
    sigma_translation: float = Field(0.1, gt=0)
    """How far off (metres) an annotated position is expected to be."""
    sigma_yaw: float = Field(0.03, gt=0)
    """How far off (radians) an annotated heading is expected to be."""


class ActorSettings(Settings):
    """The part `actors`: the vehicles that move, each a set of Gaussians in its own box's frame."""

    cap_max: int = Field(200_000, ge=1, le=20_000_000)
    """Most Gaussians of all actors together; each keeps four, however low this is."""
    least: int = Field(500, ge=1)
    """An actor may have so many Gaussians, however few pixels show it. Otherwise train.pixels_per_gaussian limits it by
    the training pixels in its box: on scene 0061 twenty times as many Gaussians cost 1 dB on what moves, held out."""
    sh_degree: int = Field(1, ge=0, le=3)
    """Highest degree of the spherical harmonics that hold their colours, in the object's frame."""
    fourier: int = Field(5, ge=1, le=16)
    """Fourier coefficients over an actor's time, of every coefficient of its colours: 1 = colours constant in time."""
    box_margin: float = Field(0.1, ge=0, le=2)
    """Gaussians whose centres are farther than this (metres) outside their box are faded out."""
    tracks: TrackSettings = TrackSettings()
