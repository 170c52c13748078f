"""What differs between a checkout and a copy that pip has installed: where the workflow's files are (config.yaml,
presets, edits, profiles), and which commands there are."""

import os
import re
from pathlib import Path

from drivesplat import IS_CHECKOUT, WORKFLOW

CONFIG = "config.yaml"


def default_config(workdir: Path, basedir: Path = WORKFLOW) -> Path:
    """The config file under all others: that of the working directory, whatever it is, or else the workflow's own."""
    return workdir / CONFIG if os.path.lexists(workdir / CONFIG) else basedir / CONFIG


def of_the_workflow(path: str | Path) -> Path:
    """The file or folder at `path`; one that the workflow brings along is found from any working directory."""
    given = Path(path).expanduser()
    return given if given.exists() or not (WORKFLOW / given).exists() else WORKFLOW / given


def in_this_copy(text: str, is_checkout: bool = IS_CHECKOUT) -> str:
    """A message with the commands of this copy: one that pip has installed comes without make, and with a Snakefile
    that only its own command knows."""
    if is_checkout:
        return text
    text = text.replace("`snakemake ", "`drivesplat run ").replace("docs/settings.md", "`drivesplat config --all`")
    text = re.sub(
        r"`?TORCH_CUDA=(\w+) make setup`?",
        r'pip install --force-reinstall "torch==2.11.*" torchvision --index-url https://download.pytorch.org/whl/\1',
        text,
    )
    text = re.sub(r"`?rm -r \.venv(;|, then| and run)? `?make setup`?", "a new installation by pip", text)
    return re.sub(r"\bmake (setup|doctor|demo)\b", r"drivesplat \1", text)
