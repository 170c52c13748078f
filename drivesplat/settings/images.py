"""Size of the images for training and evaluation."""

from pydantic import Field

from drivesplat.settings import Settings


class ImageSettings(Settings):
    width: int | None = Field(None, ge=16, le=10_000)
    """Width (pixels) to which images are resized for training and evaluation (INTER_AREA, aspect ratio kept). null =
    recorded size."""
