"""Checkpoint files: tensors and plain data only, whole or absent."""

from pathlib import Path
from typing import Any

import torch

from drivesplat.io.array_file import read_arrays, write_arrays


def save(path: Path, content: dict[str, Any]) -> None:
    """Writes tensors and plain data, atomically. Raises ResultError naming `path` where the disk is full."""
    write_arrays(path, content, torch.Tensor, lambda tensor: tensor.detach().cpu().numpy())


def load(path: Path, rule: str) -> dict[str, Any]:
    """Reads what `save` wrote, onto the CPU. Raises what `read_arrays` raises."""
    return read_arrays(path, rule, torch.from_numpy)
