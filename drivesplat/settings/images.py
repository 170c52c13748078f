"""The size at which images are used."""

from pydantic import Field

from drivesplat.settings import Settings


class ImageSettings(Settings):
    width: int | None = Field(None, ge=16, le=10_000)
    """Width in pixels to which images are resized (INTER_AREA, keeping the aspect) for training and evaluation. null
    = as recorded."""
