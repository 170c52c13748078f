"""What the stage `free_space` may be told."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings


class FreeSpaceSettings(Settings):
    """The space that rays prove empty, for trainings that ask for it (`train.floaters.free_space`)."""

    triangulated: bool = True
    """Whether rays from training images to the points that refine_poses triangulated count, beside LiDAR's."""
    voxel: float = Field(0.3, ge=0.05, le=5)
    """Edge in metres of the voxels that are told empty."""
    range: float = Field(30.0, gt=0, le=200)
    """A ray proves nothing farther than this (metres) from where it starts: half a degree that a pose is off is 0.3 m
    there."""
    margin: float = Field(0.3, ge=0, le=10)
    """A ray proves nothing of its last metres: so many, ..."""
    margin_share: float = Field(0.02, ge=0, le=1)
    """... and this fraction of its length."""
    min_rays: int = Field(3, ge=1, le=254)
    """A voxel is empty only if so many rays passed it: one that just misses a wire is no proof."""


class FreeSpaceJob(Settings):
    """Everything that decides the content of one free_space.pkl, the scene aside."""

    free_space: FreeSpaceSettings
    holdout: HoldoutSettings
    own_car_radius: float
    box_margin: float
    """Returns nearer than this (metres) to the box of something that moves do not stand still."""
