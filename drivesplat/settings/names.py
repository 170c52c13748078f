"""Checks of names: scenes and methods name folders, and scene numbers need quotes in YAML."""

import re
from typing import Any

NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$"


def require_text(scene: Any) -> None:
    """Raises ValueError, with the correct spelling, for a scene number without quotes."""
    if not isinstance(scene, str):
        octal = f'"{scene:04o}" or ' if isinstance(scene, int) else ""
        raise ValueError(
            f'scene numbers are strings: put {octal}"{scene:0>4}" in quotes, since bare YAML reads 0061 as octal 49'
        )


def require_name(name: str, kind: str) -> None:
    """Raises ValueError where `name`, of a scene or another `kind`, cannot name a folder."""
    if not re.match(NAME, name) or name in ("logs", "benchmarks"):
        raise ValueError(f"{kind} {name!r} cannot name a folder: use letters, digits, '_', '-' and '.'")
