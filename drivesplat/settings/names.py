"""What things may be called: folders bear the names of scenes and methods, and YAML reads scene numbers as numbers."""

import re
from typing import Any

NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$"


def require_text(scene: Any) -> None:
    """Raises ValueError, with what to write, where a scene number stands without quotes."""
    if not isinstance(scene, str):
        octal = f'"{scene:04o}" or ' if isinstance(scene, int) else ""
        raise ValueError(
            f'scene numbers are strings: put {octal}"{scene:0>4}" in quotes, since bare YAML reads 0061 as octal 49'
        )


def require_name(name: str, kind: str) -> None:
    """Raises ValueError where `name`, of some `kind` of thing, cannot name a folder."""
    if not re.match(NAME, name) or name in ("logs", "benchmarks"):
        raise ValueError(f"{kind} {name!r} cannot name a folder: use letters, digits, '_', '-' and '.'")
