"""Settings of films."""

from typing import Literal

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.edit import Edit
from drivesplat.settings.images import HoldoutSettings, ImageSettings

ShownParts = Literal["all", "moving", "static"]
FilmEnd = Literal["trained", "recorded"]
RECORDED_IN_WORDS = "recorded drive, rendered"
"""The caption of a film along the recorded path."""
PARTS_IN_WORDS: dict[ShownParts, str] = {
    "all": "everything", "static": "without moving objects", "moving": "moving objects alone",
}  # fmt: skip
"""What captions say of the parts that a film shows."""


class TrajectorySettings(Settings):
    """A camera path parallel to the recorded one. All zero = the recorded path."""

    lateral: float = Field(0.0, ge=-50, le=50)
    """:printed: Offset to the vehicle's left (metres). Negative = to its right."""
    vertical: float = Field(0.0, ge=-10, le=100)
    """:printed: Offset upwards (metres)."""
    yaw: float = Field(0.0, ge=-180, le=180)
    """:printed: Rotation of the camera to the left (degrees), about its own centre."""
    parts: ShownParts = "all"
    """:printed: Parts of the model to show: 'all', 'moving' (objects alone, on grey) or 'static' (the background
    without them). Methods without moving parts have only films of 'all'."""

    @property
    def in_words(self) -> str:
        """What a film along the path shows, for captions.

        >>> TrajectorySettings(lateral=-2, vertical=1, yaw=10).in_words
        '2 m to the right, 1 m up, turned 10 degrees to the left'
        >>> TrajectorySettings().in_words
        'recorded drive, rendered'
        """
        sides = {True: "to the left", False: "to the right"}
        words = [PARTS_IN_WORDS[self.parts]] if self.parts != "all" else []
        words += [f"{abs(self.lateral):g} m {sides[self.lateral > 0]}"] if self.lateral else []
        words += [f"{abs(self.vertical):g} m {'up' if self.vertical > 0 else 'down'}"] if self.vertical else []
        words += [f"turned {abs(self.yaw):g} degrees {sides[self.yaw > 0]}"] if self.yaw else []
        return ", ".join(words) or RECORDED_IN_WORDS


class RenderSettings(Settings):
    """Films along trajectories, at the recorded speed."""

    fps: int = Field(30, ge=1, le=240)
    """:printed: Frames per second."""
    width: int | None = Field(None, ge=16, le=7680, multiple_of=2)
    """:printed: Width in pixels. Even, since H.264 requires it. null = that of the training images, at most 1920, or
    where `height` is set as their aspect ratio gives it."""
    height: int | None = Field(None, ge=16, le=4320, multiple_of=2)
    """:printed: Height in pixels. Even. null = as the aspect ratio of the training images gives it."""
    horizontal_fov: float | None = Field(None, gt=1, lt=170)
    """:printed: Horizontal field of view in degrees. null = that of the evaluated camera."""
    crf: int = Field(18, ge=1, le=51)
    """H.264 constant rate factor. Lower values give better quality and larger files; 18 is visually lossless."""
    end: FilmEnd = "trained"
    """:printed: Where films of images end: 'trained' at the last training image of the evaluated camera, 'recorded' at
    the last recorded one. Beyond the training images models are blurred, or empty. Holds for films of trajectories, of
    parts, of edits and of all methods side by side."""
    captions: bool = True
    """:printed: Write into films what is shown, the seconds of the drive, and where they go beyond the last training
    image."""
    compare: bool = True
    """:printed: Make compare.mp4 with the films of a scene: its recorded images beside the renderings of all methods.
    It can always be asked for by its name."""
    quad: tuple[str, ...] = ()
    """:printed: Names of edits whose films of four panels are made with the films of a scene: recorded images, their
    reconstruction, the smooth drive, the edit. They can always be asked for: quad/{edit}.mp4."""
    lidar: bool = True
    """:printed: Make lidar.mp4 with the films of methods that render LiDAR: recorded scans beside rendered ones. It can
    always be asked for by its name."""
    recorded_once: bool = False
    """Render the frames along the recorded path once for all films of a method that show them: those of edits, of four
    panels, of parts, and of the recorded path. Saves time where there is no GPU, and takes three bytes a pixel on disk
    (recorded_frames.npy). The films are the same. For methods that can be edited."""
    edited_frames: bool = False
    """:printed: Also write the frames of edited drives as PNG, at full size, with labels in the JSON file."""
    trajectories: dict[str, TrajectorySettings] = Field(
        default_factory=lambda: {"original": TrajectorySettings(), "lateral_2m": TrajectorySettings(lateral=2.0)}
    )
    """:printed: Films to render, each under a name of your choice."""


class FilmEncoding(Settings):
    """How pictures become a film."""

    fps: int
    crf: int
    captions: bool = False


class FilmFormat(FilmEncoding):
    """The format of a film. For the film of a method's parts these are all its settings."""

    camera: str
    width: int | None
    height: int | None
    horizontal_fov: float | None
    end: FilmEnd = "recorded"
    images: ImageSettings = Field(default_factory=ImageSettings)
    holdout: HoldoutSettings = Field(default_factory=HoldoutSettings)


class FilmJob(FilmFormat):
    """All settings that determine one film along a trajectory."""

    trajectory: TrajectorySettings


class BlockFilmJob(FilmJob):
    """All settings that determine one film of a drive that is cut into blocks: the blocks that are left out, too."""

    left_out: tuple[int, ...] = ()


class EditJob(FilmFormat):
    """All settings that determine the film of one edit; `frames`: write its frames, too."""

    edit: Edit
    frames: bool = False


class BlockEditJob(EditJob):
    """All settings that determine the film of one edit of a drive that is cut into blocks."""

    left_out: tuple[int, ...] = ()


class TruthFilmJob(Settings):
    """All settings that determine the film of a method beside the truth of a synthetic world."""

    eval_camera: str
    crf: int
    captions: bool


class CompareJob(TruthFilmJob):
    """All settings that determine the film of recorded images beside the renderings of methods."""

    end: FilmEnd = "recorded"


class LidarFilmJob(Settings):
    """All settings that determine the film of recorded LiDAR scans beside rendered ones."""

    crf: int
    captions: bool
