"""The films."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.edit import Edit


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
    edited_frames: bool = False
    """Write the frames of edits as PNG, too, at full size: images of what was never recorded, with labels beside."""
    trajectories: dict[str, TrajectorySettings] = Field(default_factory=_default_trajectories)
    """Films to make, each under a name of your choice."""


class FilmFormat(Settings):
    """How a film looks, whatever it shows; of the film of a method's parts everything that decides its content."""

    camera: str
    fps: int
    width: int
    height: int
    horizontal_fov: float | None
    crf: int

    def tile(self, columns: int) -> tuple[int, int]:
        """Width and height in pixels, both even, of each of so many pictures side by side in a film of this width."""
        width = self.width // columns // 2 * 2
        return width, max(2, width * self.height // self.width // 2 * 2)


class FilmJob(FilmFormat):
    """Everything that decides the content of one film along a trajectory, its inputs aside."""

    trajectory: TrajectorySettings


class EditJob(FilmFormat):
    """Everything that decides the content of one edit's film, its inputs aside."""

    edit: Edit
    frames: bool
