"""Settings of exports."""

from pydantic import Field

from drivesplat.settings import Settings


class ExportSettings(Settings):
    usd_gaussians: int = Field(1_000_000, ge=1)
    """Maximum number of Gaussians in scene.usdz. Those with the largest opacity times area are kept."""
    viewer_gaussians: int = Field(300_000, ge=1)
    """Maximum number of Gaussians in viewer.html, which has to fit into a browser's memory."""


class ExportJob(Settings):
    """All settings that determine one scene.usdz or one viewer.html."""

    eval_camera: str
    gaussians: int
