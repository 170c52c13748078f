"""What a synthetic world may be told."""

from typing import Annotated, Literal

from pydantic import Field

from drivesplat.settings import Settings

Channel = Literal[
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT", "LIDAR_TOP"
]  # fmt: skip

Gain = Annotated[float, Field(gt=0, le=8)]


class WorldSettings(Settings):
    """A synthetic street in nuScenes format, made at the dataset's dataroot, with the truth that real logs lack."""

    random_seed: int = Field(0, ge=0, lt=2**31)
    """Seeds everything that is placed or coloured at random."""
    width: int = Field(400, ge=64, le=1600)
    """Width of all images in pixels; nuScenes has 1600. The height is 9/16 of it."""
    samples_per_pixel: int = Field(4, ge=1, le=64)
    """Rays a pixel, spread evenly over it; by day each also looks for the sun."""
    key_frames: int = Field(20, ge=2, le=40)
    """Length of the drive; key frames come at 2 Hz, from all six cameras and the LiDAR."""
    sweeps: tuple[Channel, ...] = ("CAM_FRONT",)
    """Sensors that also record between key frames: cameras at 12 Hz, the LiDAR at 20 Hz."""
    vehicles: int = Field(2, ge=0, le=6)
    """Moving vehicles: the first leads the own car, the others come towards it or drive further ahead."""
    pedestrians: int = Field(1, ge=0, le=6)
    """Walking pedestrians."""
    parked: int = Field(9, ge=0, le=16)
    """Parked vehicles."""
    ego: Literal["drives", "stands"] = "drives"
    """Whether the own car moves."""
    own_car: bool = False
    """Whether the own car's rear is seen, at the lower edge of CAM_BACK's images."""
    exposures: dict[Channel, tuple[Gain, Gain, Gain]] = Field(default_factory=dict)
    """Per camera how much of the red, green and blue light it takes in, before its images are gamma encoded; others
    take in all, 1. {CAM_BACK: [1.3, 1.2, 1.0]}: as cameras do that expose and white-balance by themselves."""
    night: bool = False
    """Street lamps, headlights and sensor noise instead of the sun."""
    pose_noise: bool = False
    """Ego poses of the kind nuScenes ships: z = 0, roll and pitch off by half a degree, positions by centimetres."""


class WorldJob(Settings):
    """What the stage `demo_world` gets: the name of the scene, the folder of tables, and the street."""

    scene: str
    version: str
    world: WorldSettings
