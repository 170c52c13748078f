"""drivesplat: turns recorded drives into 3D Gaussian splats and measures them.

Its packages are listed in docs/developing.md. Importing it is fast: modules that need torch, gsplat or nuscenes-devkit
are imported by name.
"""

from pathlib import Path
from typing import Any

_INSTALLED = Path(__file__).parent / "_workflow"
"""The workflow's files where pip has installed them (pyproject.toml); a checkout has no such folder."""
IS_CHECKOUT = not _INSTALLED.is_dir()
WORKFLOW = Path(__file__).parents[1] if IS_CHECKOUT else _INSTALLED
"""The folder of the Snakefile, with config.yaml, presets and profiles."""
SNAKEFILE = WORKFLOW / "Snakefile"

_PUBLIC = {
    "open": ("drivesplat.drive.trained_drive", "open_drive"),
    "render_poses": ("drivesplat.drive.render_files", "render_poses"),
    "LongDrive": ("drivesplat.drive.long_drive", "LongDrive"),
    "TrainedDrive": ("drivesplat.drive.trained_drive", "TrainedDrive"),
    "Camera": ("drivesplat.drive.cameras", "PoseableCamera"),
    "LiveServer": ("drivesplat.drive.live_server", "LiveServer"),
    "SensorServer": ("drivesplat.serve.server", "SensorServer"),
    "Lidar": ("drivesplat.drive.lidars", "PoseableLidar"),
}


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})


def __getattr__(name: str) -> Any:
    """The names of docs/python.md, imported when they are first used."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    module, own = _PUBLIC[name]
    return getattr(import_module(module), own)
