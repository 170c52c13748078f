"""Settings of long drives, which are cut into blocks along their path, and the names of blocks."""

import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.images import HoldoutSettings

BLOCKS = "blocks.json"
"""The file of a drive with its blocks."""
AUTO_LENGTHS = range(40, 401, 20)
"""The lengths in metres of which length_m: auto chooses one."""
_BLOCK = re.compile(r"(.+)\.(\d{3,})")


class CutSettings(Settings):
    """Where a drive is cut."""

    length_m: Annotated[float, Field(ge=20, le=10_000)] | Literal["auto"] = 150.0
    """:printed: Length in metres of the path of a block. Time does not count: a vehicle that stands makes no block.
    'auto': between 40 and 400, as long as the images of a block and its Gaussians fit into `memory_gb`
    (docs/long_drives.md)."""
    overlap_m: float = Field(40.0, ge=0, le=1_000)
    """:printed: Metres of path before and after a block whose images it is trained on, too."""
    same_place_m: float = Field(6.0, gt=0, le=50)
    """Distance in metres up to which the vehicle is back in a street that it has driven before: its images belong to
    the block of the first time."""

    @model_validator(mode="after")
    def _overlap_is_shorter(self) -> "CutSettings":
        longest = AUTO_LENGTHS[-1] if self.length_m == "auto" else self.length_m
        if self.overlap_m > longest:
            raise ValueError(f"overlap_m must be at most length_m ({longest:g})")
        return self


class CardSettings(Settings):
    """What length_m: auto chooses by: the memory of a card in GB, the maximum number of Gaussians of a training's
    background, and the width of its images in pixels (None: as recorded)."""

    memory_gb: float
    gaussians: int
    width: int | None


class BlockSettings(CutSettings):
    memory_gb: float = Field(8.0, gt=0, le=1000)
    """:printed: GPU memory (GB) for which length_m: auto chooses the length: that of the smallest card that is to train
    the blocks, whatever card the machine has."""
    init: Literal["alone", "previous"] = "alone"
    """:printed: What the training of a block starts from: 'alone' from its seed points, 'previous' from the trained
    Gaussians of the block before it. Blocks are then trained one after another (docs/long_drives.md)."""
    leave_out: tuple[int | str, ...] = ()
    """:printed: Blocks without which the results of the drive are made, such as those whose training fails, by number:
    [3]. Where the dataset has several scenes, by name: ["commute.003"]. docs/long_drives.md"""

    @field_validator("leave_out", mode="before")
    @classmethod
    def _names_are_quoted(cls, value: Any) -> Any:
        for one in value if isinstance(value, (list, tuple)) else ():
            if isinstance(one, float):
                raise ValueError(f"{one} is a number to YAML: write the name of a block in quotes")
            if isinstance(one, bool) or (isinstance(one, int) and one < 0):
                raise ValueError(f"{one} is no number of a block; they are counted from 0")
        return value

    def require_drives(self, drives: Sequence[str]) -> None:
        """Raises ValueError where `leave_out` names no block of any of the `drives` of a dataset, or a number while
        there are several drives."""
        for one in self.leave_out:
            if isinstance(one, int) and len(drives) != 1:
                raise ValueError(
                    f"blocks.leave_out names block {one}, and there are {len(drives)} scenes: name the block, such as "
                    f'"{block_scene_name(drives[0] if drives else "commute", one)}"'
                )
            if isinstance(one, str) and (drive_of(one) == one or drive_of(one) not in drives):
                raise ValueError(
                    f"blocks.leave_out names {one!r}, which is no block of any of its scenes; their names are like "
                    f"{block_scene_name(drives[0] if drives else 'commute', 3)}"
                )

    def left_out(self, drive: str) -> tuple[int, ...]:
        """The numbers of the blocks of a drive that are left out, in order."""
        numbers = (
            one if isinstance(one, int) else int(one.rpartition(".")[2])
            for one in self.leave_out
            if isinstance(one, int) or drive_of(one) == drive
        )
        return tuple(sorted(set(numbers)))


class BlocksJob(Settings):
    """All settings that determine the blocks of a drive; `card` where their length is chosen."""

    blocks: CutSettings
    holdout: HoldoutSettings
    card: CardSettings | None = None


class PooledJob(Settings):
    """All settings that determine the figures of a drive, given those of its blocks."""

    left_out: tuple[int, ...]
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
