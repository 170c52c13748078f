"""The folder of all results, as it stands in the paths of files."""

import os
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field


def _usable(given: str) -> str:
    """The folder with ~ expanded and without '.', '..' and '/' that change nothing. Raises ValueError where Snakemake
    could not use it."""
    if "://" in given:
        raise ValueError("results are files of this machine; name a folder, and copy it afterwards")
    if not given.isprintable() or set(given) & set("{}<>*?[]\\"):
        raise ValueError("a folder's name cannot hold { } < > * ? [ ] \\ or control characters here")
    try:
        folder = os.path.normpath(Path(given).expanduser())
    except RuntimeError:
        raise ValueError("there is no such home folder; write the path in full") from None
    if folder in (".", "/") or Path(folder).name == "..":
        raise ValueError("results need a folder of their own; name one, as in results/first")
    return folder


ResultsFolder = Annotated[str, Field(min_length=1), AfterValidator(_usable)]
"""A folder for results, relative to the working directory or absolute."""
