"""Settings of published figures, which the report shows beside measured ones."""

import re
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.names import require_text

MEAN = "mean"
"""In place of a scene: the figures are means over scenes."""
FIGURES = ("psnr", "ssim", "lpips", "train_minutes")


class PublishedFigures(Settings):
    """The figures of one method on one scene, as published."""

    source: str = Field(min_length=1, max_length=100)
    """Name of the publication. Its figures are one table of the report."""
    url: str
    """Address of the publication."""
    scene: str = Field(min_length=1, max_length=100)
    """Scene, as datasets.<name>.scenes names it, or mean."""
    scenes: int | None = Field(None, ge=1)
    """Number of scenes of a mean. It is compared with measured means over as many scenes only. null = any number."""
    method: str = Field(min_length=1, max_length=100)
    """Name of the method in the publication."""
    group: Literal["interpolation", "extrapolation"] = "interpolation"
    """Group of held-out images that the figures are compared with."""
    region: Literal["all", "static", "vehicle", "car", "moving_vehicle", "parked_vehicle", "moving_human"] = "all"
    """Pixels that the figures are compared with."""
    psnr: float | None = Field(None, gt=0, le=100)
    """PSNR in dB: the mean over images. It is compared with psnr_frame_mean."""
    ssim: float | None = Field(None, ge=-1, le=1)
    """SSIM."""
    lpips: float | None = Field(None, ge=0, le=10)
    """LPIPS."""
    train_minutes: float | None = Field(None, gt=0)
    """Training time in minutes."""
    gpu: str | None = Field(None, max_length=100)
    """GPU of the training."""

    @field_validator("url")
    @classmethod
    def _url_is_an_address(cls, value: str) -> str:
        if not re.fullmatch(r"https?://[^\s\"'<>]+", value):
            raise ValueError("it must be the address of a page, as https://arxiv.org/abs/2401.01339")
        return value

    @field_validator("scene", mode="before")
    @classmethod
    def _scene_is_quoted(cls, value: Any) -> Any:
        require_text(value)
        return value

    @model_validator(mode="after")
    def _figures_are_there(self) -> "PublishedFigures":
        if all(getattr(self, name) is None for name in FIGURES):
            raise ValueError(f"no figure is given; give at least one of {', '.join(FIGURES)}")
        if self.scenes is not None and self.scene != MEAN:
            raise ValueError(f"scenes counts the scenes of a mean; set scene: {MEAN}, or leave it out")
        return self
