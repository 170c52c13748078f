"""Settings of synthetic worlds."""

from typing import Annotated, Literal

from pydantic import Field

from drivesplat.settings import Settings

Channel = Literal[
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT", "LIDAR_TOP"
]  # fmt: skip

Gain = Annotated[float, Field(gt=0, le=8)]


class WorldSettings(Settings):
    """A synthetic street in nuScenes format, generated at the dataset's dataroot, with ground truth that recorded
    drives lack."""

    random_seed: int = Field(0, ge=0, lt=2**31)
    """Random seed of placement and colours."""
    width: int = Field(400, ge=64, le=1600)
    """Width of all images in pixels (nuScenes: 1600). The height is 9/16 of it."""
    samples_per_pixel: int = Field(4, ge=1, le=64)
    """Rays per pixel, evenly spread. By day each has a shadow ray."""
    key_frames: int = Field(20, ge=2, le=40)
    """Number of key frames, at 2 Hz, of all six cameras and the LiDAR."""
    sweeps: tuple[Channel, ...] = ("CAM_FRONT",)
    """Sensors that also record between key frames: cameras at 12 Hz, the LiDAR at 20 Hz."""
    vehicles: int = Field(2, ge=0, le=6)
    """Number of moving vehicles. The first drives ahead of the ego vehicle; the others are oncoming or further ahead.
    """
    pedestrians: int = Field(1, ge=0, le=6)
    """Number of walking pedestrians."""
    parked: int = Field(9, ge=0, le=16)
    """Number of parked vehicles."""
    ego: Literal["drives", "stands"] = "drives"
    """Motion of the ego vehicle."""
    own_car: bool = False
    """Show the rear of the ego vehicle at the lower edge of CAM_BACK's images."""
    exposures: dict[Channel, tuple[Gain, Gain, Gain]] = Field(default_factory=dict)
    """Gains of the red, green and blue channels before gamma encoding, by camera: {CAM_BACK: [1.3, 1.2, 1.0]}. Other
    cameras have 1. They imitate cameras with independent exposure and white balance."""
    night: bool = False
    """Street lamps, headlights and sensor noise instead of the sun."""
    pose_noise: bool = False
    """Give ego poses the errors of nuScenes: z = 0, roll and pitch off by half a degree, positions by centimetres."""


class WorldJob(Settings):
    """Settings of the rule `demo_world`: name of the scene, name of the folder of tables, and the street."""

    scene: str
    version: str
    world: WorldSettings
