"""Settings of the rule `free_space`."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.images import HoldoutSettings


class FreeSpaceSettings(Settings):
    """Space that rays prove empty, for trainings with `train.floaters.free_space`."""

    triangulated: bool = True
    """Use rays from training images to the points that refine_poses triangulated, in addition to LiDAR rays."""
    voxel: float = Field(0.3, ge=0.05, le=5)
    """Edge length of the voxels (metres)."""
    range: float = Field(30.0, gt=0, le=200)
    """Maximum distance from the sensor (metres) up to which a ray marks space as empty. A pose error of half a degree
    shifts a point by 0.3 m at 30 m."""
    margin: float = Field(0.3, ge=0, le=10)
    """Distance before the end of a ray (metres) that is not marked as empty. margin_share is added to it."""
    margin_share: float = Field(0.02, ge=0, le=1)
    """Fraction of the ray's length before its end that is not marked as empty, in addition to margin."""
    min_rays: int = Field(3, ge=1, le=254)
    """Minimum number of rays that must pass a voxel for it to be empty."""


class FreeSpaceJob(Settings):
    """All settings that determine the free space of one scene."""

    free_space: FreeSpaceSettings
    holdout: HoldoutSettings
    own_car_radius: float
    box_margin: float
    """Returns within this distance (metres) of the box of a moving object are dynamic."""
