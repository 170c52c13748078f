"""Whether a version of nuScenes has annotations, for planning: v1.0-test has none."""

import re
from pathlib import Path

MAX_EMPTY = 64
"""Characters of a table without rows, at most."""


def has_tracks(root: Path, version: str, scene: str) -> bool | None:
    """False where the table of annotations has no rows. None where it has some, which may be those of other scenes, or
    cannot be read."""
    try:
        with open(root / version / "sample_annotation.json", encoding="utf-8") as file:
            return False if re.fullmatch(r"\s*\[\s*\]\s*", file.read(MAX_EMPTY)) else None
    except (OSError, ValueError):
        return None
