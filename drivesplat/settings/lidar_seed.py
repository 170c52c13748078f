"""What the stage `lidar_seed` may be told."""

from typing import Annotated

from pydantic import Field, field_validator

from drivesplat.settings import Settings
from drivesplat.settings.extract import OnMissing
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.images import ImageSettings


class LidarSeedSettings(Settings):
    on_missing: OnMissing = "stop"
    """A missing or corrupt LiDAR file: 'stop' names it and fails; 'warn' goes on without it and counts it."""
    sweeps: bool = False
    """Use the LiDAR sweeps between key frames, too (nuScenes: at 20 Hz, ten times the returns): for this seed, for what
    actors start from, and for LiDAR's depth in training images, which then see the sweep of their own moment. Those
    nearer than half a key-frame interval to a held-out key frame contribute nothing. docs/real_logs.md"""
    points_file: str | None = None
    """A PLY of extra points in the dataset's global frame (metres), recoloured from training images. null = none."""
    triangulated: bool = True
    """Whether points that refine_poses triangulated, and two training images see, join the seed."""
    max_points: int = Field(400_000, ge=100, le=10_000_000)
    """Most points from LiDAR, triangulation and the points file; beyond it they are thinned at random."""
    voxel_size: float = Field(0.1, ge=0, le=10)
    """Edge in metres of the voxels that keep one LiDAR point each. 0 = no thinning."""
    own_car_radius: float = Field(2.5, ge=0, le=10)
    """LiDAR returns nearer to the sensor than this (metres, horizontally) are the own car's and are left out."""
    box_margin: float = Field(0.2, ge=0, le=2)
    """Boxes of moving objects are grown by this (metres) before the points in them are left out."""
    far_points: int = Field(80_000, ge=0, le=2_000_000)
    """Random points along pixels that no other seed point covers (sky, tall buildings, missing LiDAR). 0 = none."""
    far_depths: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]] = (3.0, 300.0)
    """Nearest and farthest depth of far points in metres (log-uniform between; never under the road)."""

    @field_validator("far_depths")
    @classmethod
    def _nearest_first(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] >= value[1]:
            raise ValueError("the nearest depth must be under the farthest")
        return value


class SeedJob(Settings):
    """Everything that decides the content of one seed.ply, the scene aside."""

    lidar_seed: LidarSeedSettings
    holdout: HoldoutSettings
    images: ImageSettings
    random_seed: int
