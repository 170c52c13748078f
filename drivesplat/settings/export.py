"""What leaves the workflow: splats for other programs."""

from pydantic import Field

from drivesplat.settings import Settings


class ExportSettings(Settings):
    usd_gaussians: int = Field(1_000_000, ge=1)
    """At most so many Gaussians in scene.usdz: those that cover most."""
    viewer_gaussians: int = Field(300_000, ge=1)
    """At most so many Gaussians in viewer.html: those that cover most. A browser's memory is the limit."""


class UsdJob(Settings):
    """Everything that decides the content of one scene.usdz, its inputs aside."""

    eval_camera: str
    gaussians: int


class ViewerJob(Settings):
    """Everything that decides the content of one viewer.html, its inputs aside."""

    eval_camera: str
    gaussians: int
