"""The films."""

from pydantic import Field

from drivesplat.settings import Settings


class RenderSettings(Settings):
    """Films along a trajectory."""

    fps: int = Field(30, ge=1, le=240)
    """Frames per second."""
    width: int = Field(1920, ge=16, le=7680)
    """Width in pixels."""
    height: int = Field(1080, ge=16, le=4320)
    """Height in pixels."""
