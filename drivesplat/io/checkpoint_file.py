"""Checkpoint files: tensors and plain data only, whole or absent."""

from pathlib import Path
from typing import Any

import torch

from drivesplat.io.storage import atomic_write, unreadable


def save(path: Path, content: dict[str, Any]) -> None:
    """Writes tensors and plain data, atomically. Raises ResultError naming `path` where the disk is full."""
    with atomic_write(path) as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # what torch's zip writer makes of a failed write
            raise OSError(f"torch could not write it: {str(error).splitlines()[0]}") from error


def load(path: Path, rule: str) -> dict[str, Any]:
    """Reads what `save` wrote; nothing in the file is executed.

    Raises ResultError naming the file and `rule` where it is truncated, foreign, or holds anything but tensors and
    plain data.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # zip, pickle and torch each fail in their own way
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise unreadable(path, rule, f"not a checkpoint of this workflow ({reason})") from error
    if not isinstance(content, dict):
        raise unreadable(path, rule, "not a checkpoint of this workflow (it holds no record)")
    return content
