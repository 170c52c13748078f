"""Whether a folder holds nuScenes' tables, and the scenes in them, for the check of recordings."""

import json
from collections.abc import Iterator
from pathlib import Path

from drivesplat.errors import DatasetError
from drivesplat.io.regular_file import regular_file
from drivesplat.readers.nuscenes.scene_tables import PREFIX
from drivesplat.readers.recognised import Recognised

FORMAT, SIGN, PAGE = "nuScenes tables", "VERSION/scene.json and sample_data.json", "docs/data.md"
TABLE = "sample_data.json"


def recognised(folder: Path) -> Iterator[Recognised]:
    """The versions of nuScenes in a folder: it is one, or holds them, or the folder that holds them. Raises
    DatasetError for a table of scenes that is damaged."""
    for table in sorted({*folder.glob(TABLE), *folder.glob(f"*/{TABLE}"), *folder.glob(f"*/*/{TABLE}")}):
        version = table.parent.absolute()
        file = version / "scene.json"
        if not file.is_file():
            continue
        try:
            rows = json.loads(regular_file(file).read_text(encoding="utf-8"))
            names = tuple(sorted(row["name"].removeprefix(PREFIX) for row in rows))
        except (AttributeError, KeyError, OSError, RecursionError, TypeError, ValueError) as error:
            raise DatasetError(f"{file} cannot be read ({type(error).__name__}: {error}); unpack it again") from error
        yield Recognised(version.parent, version.name, names, version / TABLE)
