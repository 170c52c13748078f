"""The common header of exported JSON files: scene, coordinate conventions and origin."""

from collections.abc import Mapping
from typing import Any

from drivesplat.scene.scene import Scene

GLOBAL = "A position in the dataset's global frame is its world position plus origin."


def scene_header(scene: Scene, schema: int, conventions: Mapping[str, str]) -> dict[str, Any]:
    """The first entries of a record of `scene`; `origin` (3,) in metres, with full float64 precision."""
    return {
        "schema": schema,
        "scene": scene.name,
        "dataset": scene.dataset,
        "version": scene.version,
        "poses": scene.poses,
        "conventions": {"global": GLOBAL, **conventions},
        "origin": scene.origin.tolist(),
    }
