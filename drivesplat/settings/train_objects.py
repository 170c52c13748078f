"""Settings of the parts of a model that consist of objects: moving vehicles, people and animals."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.deformable import GaitSettings, LatticeSettings


class TrackSettings(Settings):
    """Learned corrections of the annotated poses of actors. Poses between annotations are interpolated smoothly."""

    corrected: bool = True
    """Correct annotated positions and headings."""
    lr_translation: float = Field(1e-3, gt=0)
    """Learning rate of the position corrections (metres)."""
    lr_yaw: float = Field(5e-4, gt=0)
    """Learning rate of the heading corrections (radians)."""
    l2_weight: float = Field(0.001, ge=0)
    """Loss weight of the mean square of the corrections, in units of `sigma_translation` and `sigma_yaw`."""
    smoothness_weight: float = Field(0.001, ge=0)
    """Loss weight of the mean square of their second differences along a track over half a second, in the same units.
    It keeps corrections smooth, so that they hold for the held-out frames in between (docs/street.md)."""
    sigma_translation: float = Field(0.1, gt=0)
    """Expected error of an annotated position (metres)."""
    sigma_yaw: float = Field(0.03, gt=0)
    """Expected error of an annotated heading (radians)."""


class ActorSettings(Settings):
    """The part `actors`: moving vehicles, each a set of Gaussians in the frame of its box."""

    cap_max: int = Field(200_000, ge=1, le=20_000_000)
    """Maximum number of Gaussians of all actors together. Each actor keeps at least four."""
    min_gaussians: int = Field(500, ge=1)
    """Number of Gaussians that every actor may have. Beyond it, train.pixels_per_gaussian limits an actor by the number
    of training pixels in its box."""
    sh_degree: int = Field(1, ge=0, le=3)
    """Degree of the spherical harmonics of their colours, in the object's frame."""
    fourier: int = Field(5, ge=1, le=16)
    """Number of Fourier coefficients over time of every colour coefficient. 1 = colours constant in time."""
    box_margin: float = Field(0.1, ge=0, le=2)
    """Gaussians with centres farther than this (metres) outside their box are faded out."""
    tracks: TrackSettings = TrackSettings()

    def for_scene(self, cap: int, objects: int, views: int) -> "ActorSettings":
        """The settings for so many `objects`, of at most `cap` Gaussians, in a scene of so many training `views`."""
        return self.model_copy(update={"cap_max": min(self.cap_max, cap)})


class DeformableSettings(ActorSettings):
    """The part `deformable`: people, animals and cyclists, each a set of Gaussians in the frame of its box that deform
    with the distance walked and with time (docs/street.md)."""

    sh_degree: int = Field(0, ge=0, le=3)
    """Degree of the spherical harmonics of their colours. 0 = the same colour from all directions. Higher degrees
    overfit (docs/tried.md)."""
    fourier: int = Field(1, ge=1, le=16)
    """Number of Fourier coefficients over time of every colour coefficient, and of shapes beside the gait. 1 = colours
    are constant in time, and shapes change with the gait alone, so that who stands does not move. More of them overfit
    (docs/tried.md)."""
    mirrored: float = Field(0.5, ge=0, le=1)
    """Probability with which an iteration mirrors an object, left for right and half a cycle later in its gait, so that
    each side learns from images of the other."""
    mirrored_images: int = Field(30, ge=1)
    """Number of training images per camera in which an object is present, up to which `mirrored` applies in full. With
    more of them the probability falls, to 0 at twice as many: they show both sides, and how these differ."""
    gait: GaitSettings = GaitSettings()
    lattice: LatticeSettings = LatticeSettings()

    def for_scene(self, cap: int, objects: int, views: int) -> "ActorSettings":
        lattice = self.lattice.for_scene(objects, views)
        return super().for_scene(cap, objects, views).model_copy(update={"lattice": lattice})
