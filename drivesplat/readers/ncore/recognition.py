"""Whether a folder holds NCore clips, for the check of recordings."""

from collections.abc import Iterator
from pathlib import Path

from drivesplat.readers.ncore.layout import _clips
from drivesplat.readers.recognised import Recognised

FORMAT, SIGN, PAGE = "NCore clips", "*.ncore4*.zarr.itar", "docs/ncore.md"


def recognised(folder: Path) -> Iterator[Recognised]:
    """The clips in a folder, in its folders and in theirs."""
    if clips := _clips(folder):
        yield Recognised(folder.absolute(), "", tuple(clips), next(iter(clips.values()))[0])
