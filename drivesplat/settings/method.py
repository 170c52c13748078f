"""What a method is."""

from typing import Any

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.train import PartName


class MethodSettings(Settings):
    parts: tuple[PartName, ...] = Field(("background",), min_length=1)
    """What the model is made of."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Settings of this file that differ for this method, as a tree; `sky`, `train` and `random_seed` (of its training)
    may."""
