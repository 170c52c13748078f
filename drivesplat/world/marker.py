"""The marker file of a synthetic world, which keeps its generation from overwriting a recorded dataset."""

import shutil
from pathlib import Path

from drivesplat.errors import ConfigError
from drivesplat.io.storage import Provenance, write_json

WORLD_MARKER = "world.json"
"""Holds the provenance of the world in the same folder."""


def refuse_foreign_data(root: Path) -> None:
    """Raises ConfigError where `root` holds files but no marker."""
    if not (root / WORLD_MARKER).is_file() and any(path.is_file() for path in root.rglob("*")):
        raise ConfigError(
            f"{root} is configured for a synthetic world, but holds other files ({WORLD_MARKER} is missing), which "
            "the world would overwrite: set another datasets.<name>.dataroot, or empty the folder"
        )


def prepare_folder(root: Path, provenance: Provenance) -> None:
    """Deletes an earlier world in `root` and writes the marker. Raises ConfigError where `root` holds anything else."""
    refuse_foreign_data(root)
    for folder in ("samples", "sweeps", "maps", "truth", "semantic", "sky", "stretches"):
        shutil.rmtree(root / folder, ignore_errors=True)
    write_marker(root, provenance)


def write_marker(root: Path, provenance: Provenance) -> None:
    """Writes the marker into a world's folder."""
    write_json(root / WORLD_MARKER, {"provenance": provenance})
