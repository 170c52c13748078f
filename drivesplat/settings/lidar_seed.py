"""Settings of the rule `lidar_seed`."""

from typing import Annotated

from pydantic import Field, field_validator

from drivesplat.settings import Settings
from drivesplat.settings.extract import OnMissing
from drivesplat.settings.images import HoldoutSettings, ImageSettings


class LidarSeedSettings(Settings):
    on_missing: OnMissing = "stop"
    """:printed: Action for a missing or corrupt LiDAR file: 'stop' fails and names it; 'warn' skips it and counts
    it."""
    sweeps: bool = False
    """:printed: Use LiDAR sweeps between key frames, too (nuScenes: 20 Hz, ten times the returns): for this seed, for
    the seeds of actors, and for the LiDAR depth of training images, which then comes from the sweep nearest in time.
    Sweeps within half a key-frame interval of a held-out key frame are excluded. docs/real_logs.md"""
    points_file: str | None = None
    """:printed: PLY file with additional seed points in the dataset's global frame (metres), coloured from training
    images. null = none."""
    triangulated: bool = True
    """Add points that refine_poses triangulated and at least two training images see."""
    max_points: int = Field(400_000, ge=100, le=10_000_000)
    """:printed: Maximum number of points from LiDAR, triangulation and the points file. Further points are dropped at
    random."""
    voxel_size: float = Field(0.1, ge=0, le=10)
    """Edge length (metres) of the voxels that keep one LiDAR point each. 0 = no thinning."""
    own_car_radius: float = Field(2.5, ge=0, le=10)
    """Horizontal distance from the LiDAR (metres) within which returns belong to the ego vehicle and are left out."""
    box_margin: float = Field(0.2, ge=0, le=2)
    """Margin (metres) around boxes of moving objects in which points are left out."""
    far_points: int = Field(80_000, ge=0, le=2_000_000)
    """Number of random points along pixels that no other seed point covers (sky, tall buildings, missing LiDAR). Above
    seed points that are higher than the ground they have the same depth, as facades and trees do."""
    far_depths: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]] = (3.0, 300.0)
    """Minimum and maximum depth of all other far points (metres), log-uniformly distributed and never below the road.
    """
    far_near: float = Field(0.0, ge=0, le=1)
    """Fraction of these other far points that have about the depth of seed points near in the image instead. 0.6 helps
    drives with little LiDAR (docs/off_the_lane.md)."""

    @field_validator("far_depths")
    @classmethod
    def _nearest_first(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] >= value[1]:
            raise ValueError("the nearest depth must be under the farthest")
        return value


class SeedJob(Settings):
    """All settings that determine the seed.ply of one scene."""

    lidar_seed: LidarSeedSettings
    holdout: HoldoutSettings
    images: ImageSettings
    random_seed: int
