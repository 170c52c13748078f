"""What a method is."""

from typing import Any

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.train import Parts


class MethodSettings(Settings):
    parts: Parts = ("background",)
    """What the model is made of; a background is always among it."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Settings of this file that differ for this method, as a tree; `sky`, `train` and `random_seed` (of its training)
    may."""
