"""Checks of names: scenes, methods and datasets name folders, scene numbers need quotes in YAML, and results have a
folder of their own."""

import os
import re
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from drivesplat.settings import not_text, quoted
from drivesplat.settings.tracks import OTHER_TRACKS

NAME = r"[A-Za-z0-9_][A-Za-z0-9_.-]*"
MAX_LENGTH = 100
"""Characters of a name: file systems allow 255 bytes, and the workflow adds prefixes and suffixes."""
RESERVED = ("logs", "benchmarks", "masks", "images", "classes", "sweeps", "undistorted", *OTHER_TRACKS)
"""Folders of the workflow beside those of scenes and methods."""
RESULT_SUFFIXES = (".csv", ".html", ".json", ".mp4", ".npz", ".pkl", ".ply", ".png", ".usdz")
"""Suffixes of files of the workflow beside folders of scenes and methods."""


def require_text(scene: Any) -> None:
    """Raises ValueError for a scene's name that is no text, such as a number without quotes."""
    if not isinstance(scene, str):
        octal = " (which reads 0061 as octal 49)" if type(scene) is int else ""
        raise ValueError(not_text(scene, "the name of a scene", octal))


def require_name(name: str, kind: str) -> None:
    """Raises ValueError where `name`, of a scene or another `kind`, cannot name a folder or is that of a result."""
    if len(name) > MAX_LENGTH:
        raise ValueError(f"{kind} {quoted(name)} has {len(name)} characters; use at most {MAX_LENGTH}")
    if not re.fullmatch(NAME, name):
        raise ValueError(f"{kind} {name!r} cannot name a folder: use letters, digits, '_', '-' and '.'")
    if name in RESERVED or name.endswith(RESULT_SUFFIXES):
        raise ValueError(f"{kind} {name!r} cannot name a folder: results of the workflow are called so; rename it")


def suggestion(name: str, known: Iterable[str]) -> str:
    """'did you mean 0103? ' for a `name` that resembles one of those `known`; empty if none does."""
    names = list(known)
    padded = [other for other in names if name and other.lstrip("0") == name.lstrip("0")]
    found = [*padded, *get_close_matches(name, names, n=1)]
    return f"did you mean {found[0]}? " if found else ""


def _usable_folder(given: str) -> str:
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


ResultsFolder = Annotated[str, Field(min_length=1), AfterValidator(_usable_folder)]
"""A folder for results, relative to the working directory or absolute."""
