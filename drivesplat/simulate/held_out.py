"""What was measured of a drive's held-out images and scans, to which their expected errors are fitted."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from drivesplat.io.storage import read_json, unreadable

GROUPS = ("interpolation", "extrapolation")
"""The groups of held-out images and scans to which a drive is fitted."""
GROWTHS = (0.1, 10.0)
"""Limits of how fast a drive gets worse beside what it was trained on."""
Read = TypeVar("Read")


def held_out_figures(folder: Path, *keys: str) -> dict[str, float]:
    """The figure of these keys of each group of GROUPS that has it in eval.json in a method's result folder;
    none without this file. Raises ResultError for an invalid one."""

    def figures(content: dict[str, Any]) -> dict[str, float]:
        found = {}
        for name in GROUPS:
            value = content["result"].get(name)
            for key in keys:
                value = None if value is None else value.get(key)
            if value is not None:
                found[name] = float(value)
        return found

    return read_metrics(folder, figures) or {}


def read_metrics(folder: Path, read: Callable[[dict[str, Any]], Read]) -> Read | None:
    """What `read` takes from eval.json in a method's result folder; None without this file. Raises ResultError where it
    is not as `read` expects."""
    file = folder / "eval.json"
    if not file.is_file():
        return None
    content = read_json(file, "evaluate")
    try:
        return read(content)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(file, "evaluate", f"not a record of metrics ({error})") from error
