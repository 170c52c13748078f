"""What tells a synthetic world's folder from a recorded dataset's, so that making the one never harms the other."""

import shutil
from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.io.storage import write_json

WORLD_MARK = "world.json"
"""Beside the folders of a synthetic world: that it was made here, and from which settings and code."""


def refuse_foreign_data(root: Path) -> None:
    """Raises ConfigError where `root`, in which a world is to be made, holds anything that was not."""
    if not (root / WORLD_MARK).is_file() and any(path.is_file() for path in root.rglob("*")):
        raise ConfigError(
            f"{root} is to hold a synthetic world, but holds other files ({WORLD_MARK} is missing), which making one "
            "would overwrite: set another datasets.<name>.dataroot, or empty that folder"
        )


def begin(root: Path, provenance: dict[str, Any]) -> None:
    """Empties `root` of an earlier world and marks it. Raises ConfigError where it holds anything else."""
    refuse_foreign_data(root)
    for folder in ("samples", "sweeps", "maps", "truth"):
        shutil.rmtree(root / folder, ignore_errors=True)
    write_json(root / WORLD_MARK, {"provenance": provenance})
