"""Scene numbers, which YAML would rather read as numbers."""

from typing import Any


def require_text(scene: Any) -> None:
    """Raises ValueError, with what to write, where a scene number stands without quotes."""
    if not isinstance(scene, str):
        octal = f'"{scene:04o}" or ' if isinstance(scene, int) else ""
        raise ValueError(
            f'scene numbers are strings: put {octal}"{scene:0>4}" in quotes, since bare YAML reads 0061 as octal 49'
        )
