"""What places an export in the world: the scene it is of, and how its coordinates are to be read."""

from collections.abc import Mapping
from typing import Any

from drivesplat.scene.scene import Scene

GLOBAL = "A position in the dataset's global frame is its world position plus origin."


def placement(scene: Scene, schema: int, conventions: Mapping[str, str]) -> dict[str, Any]:
    """How a record of `scene` begins; `origin` (3,) in metres keeps its float64."""
    return {
        "schema": schema,
        "scene": scene.name,
        "dataset": scene.dataset,
        "version": scene.version,
        "poses": scene.poses,
        "conventions": {"global": GLOBAL, **conventions},
        "origin": scene.origin.tolist(),
    }
