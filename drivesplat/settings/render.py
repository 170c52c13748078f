"""The films."""

from pydantic import Field

from drivesplat.settings import Settings


class TrajectorySettings(Settings):
    """A path beside the recorded one, as the recording car would have driven it; all zero: the recorded path."""

    lateral: float = Field(0.0, ge=-50, le=50)
    """Metres to the car's left; negative: to its right."""
    vertical: float = Field(0.0, ge=-10, le=100)
    """Metres up."""
    yaw: float = Field(0.0, ge=-180, le=180)
    """Degrees that the camera turns to the left, about its own centre."""


def _default_trajectories() -> dict[str, TrajectorySettings]:
    return {"original": TrajectorySettings(), "lateral_2m": TrajectorySettings(lateral=2.0)}


class RenderSettings(Settings):
    """Films along trajectories, at the speed of the drive."""

    fps: int = Field(30, ge=1, le=240)
    """Frames per second."""
    width: int = Field(1920, ge=16, le=7680, multiple_of=2)
    """Width in pixels; even, as H.264 wants it."""
    height: int = Field(1080, ge=16, le=4320, multiple_of=2)
    """Height in pixels; even."""
    horizontal_fov: float | None = Field(None, gt=1, lt=170)
    """Horizontal field of view in degrees. null = the evaluated camera's own."""
    crf: int = Field(18, ge=1, le=51)
    """H.264's constant rate factor: lower is better and larger, 18 is visually lossless."""
    trajectories: dict[str, TrajectorySettings] = Field(default_factory=_default_trajectories)
    """Films to make, each under a name of your choice."""


class FilmJob(Settings):
    """Everything that decides the content of one film, its inputs aside."""

    camera: str
    trajectory: TrajectorySettings
    fps: int
    width: int
    height: int
    horizontal_fov: float | None
    crf: int
