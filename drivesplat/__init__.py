"""drivesplat: turns recorded drives into 3D Gaussian splats and measures them.

Its packages are listed in docs/developing.md. Importing it is fast: modules that need torch, gsplat or nuscenes-devkit
are imported by name.
"""

from pathlib import Path

_INSTALLED = Path(__file__).parent / "_workflow"
"""The workflow's files where pip has installed them (pyproject.toml); a checkout has no such folder."""
IS_CHECKOUT = not _INSTALLED.is_dir()
WORKFLOW = Path(__file__).parents[1] if IS_CHECKOUT else _INSTALLED
"""The folder of the Snakefile, with config.yaml, presets and profiles."""
SNAKEFILE = WORKFLOW / "Snakefile"
