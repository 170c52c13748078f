"""Whether a folder holds segments of the Waymo Open Dataset, for the check of recordings."""

from collections.abc import Iterator
from pathlib import Path

from drivesplat.readers.recognised import Recognised
from drivesplat.readers.waymo.layout import _segments
from drivesplat.readers.waymo.names import COMPONENTS, V1, V2

FORMAT, SIGN, PAGE = "Waymo segments", f"{COMPONENTS[0]}/*.parquet or *.tfrecord", "docs/waymo.md"


def recognised(folder: Path) -> Iterator[Recognised]:
    """The segments in a folder, or in the folder around one of v2's components, by version."""
    root = folder.absolute()
    root = root.parent if root.name in COMPONENTS and _segments(root.parent, V2) else root
    for version in (V2, V1):
        if segments := _segments(root, version):
            yield Recognised(root, version, tuple(sorted(segments)), segments[min(segments)])
