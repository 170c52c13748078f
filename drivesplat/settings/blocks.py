"""Settings of long drives, which are cut into blocks along their path, and the names of blocks."""

import re

from pydantic import Field, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.images import HoldoutSettings

_BLOCK = re.compile(r"(.+)\.(\d{3,})")


class BlockSettings(Settings):
    length_m: float = Field(150.0, ge=20, le=10_000)
    """:printed: Length in metres of the path of a block. Time does not count: a vehicle that stands makes no block."""
    overlap_m: float = Field(40.0, ge=0, le=1_000)
    """:printed: Metres of path before and after a block whose images it is trained on, too."""
    same_place_m: float = Field(6.0, gt=0, le=50)
    """Distance in metres up to which the vehicle is back in a street that it has driven before: its images belong to
    the block of the first time."""

    @model_validator(mode="after")
    def _overlap_is_shorter(self) -> "BlockSettings":
        if self.overlap_m > self.length_m:
            raise ValueError(f"overlap_m must be at most length_m ({self.length_m:g})")
        return self


class BlocksJob(Settings):
    """All settings that determine the blocks of a drive."""

    blocks: BlockSettings
    holdout: HoldoutSettings


def block_scene_name(drive: str, number: int) -> str:
    """The name of the scene that is block `number` of a drive.

    >>> block_scene_name("commute", 7)
    'commute.007'
    """
    return f"{drive}.{number:03d}"


def drive_of(scene: str) -> str:
    """The drive that a scene with the name of a block belongs to; the scene itself for any other name.

    >>> drive_of("commute.007"), drive_of("commute")
    ('commute', 'commute')
    """
    found = _BLOCK.fullmatch(scene)
    return found[1] if found else scene
