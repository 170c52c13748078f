"""Settings of the images: their size, the held-out key frames, and the rule `parser`."""

from pydantic import Field, model_validator

from drivesplat.settings import Settings

NEIGHBOURHOOD_HZ = 5.0
"""Key frames a second from which `holdout.neighbourhood_s` applies."""


class ImageSettings(Settings):
    width: int | None = Field(None, ge=16, le=10_000)
    """:printed: Width (pixels) to which images are resized for training and evaluation (INTER_AREA, aspect ratio kept).
    null = recorded size."""


class HoldoutSettings(Settings):
    every_nth: int = Field(8, ge=0)
    """:printed: Hold out every so many key frames, from key frame `offset` on: group 'interpolation'. 0 = none."""
    offset: int = Field(4, ge=0)
    """:printed: The first of these key frames, at most every_nth: every_nth: 10 and offset: 10 hold out 10, 20, 30, ...
    0 would hold out the first key frame, which has no predecessor."""
    last_block: int = Field(4, ge=0)
    """:printed: Number of key frames held out at the end of the drive: group 'extrapolation'. 0 = none."""
    neighbourhood_s: float = Field(0.25, ge=0, le=5)
    """:printed: Time in seconds around a held-out key frame in which nothing is trained on, for datasets with 5 key
    frames a second or more. Below that rate it is half the interval between key frames."""
    cameras: tuple[str, ...] = ()
    """:printed: Cameras of which no image is trained on: views from elsewhere at the times of training images, group
    'side_camera'. Any of `cameras` but eval_camera."""

    @model_validator(mode="after")
    def _offset_within_period(self) -> "HoldoutSettings":
        if self.every_nth and self.offset > self.every_nth:
            raise ValueError(
                f"offset must be at most every_nth ({self.every_nth}): it is the first key frame that is held out"
            )
        return self

    def held_out(self, count: int) -> dict[str, list[int]]:
        """Held-out indices by group, of `count` key frames. A key frame in both groups belongs to the last block."""
        block = list(range(max(0, count - self.last_block), count))
        nth = range(self.offset, count, self.every_nth) if self.every_nth else range(0)
        return {"interpolation": [i for i in nth if i not in block], "extrapolation": block}


class ParserJob(Settings):
    """All settings that determine the training record of one scene."""

    holdout: HoldoutSettings
    images: ImageSettings


class LightJob(ParserJob):
    """All settings that determine the light of one scene."""
