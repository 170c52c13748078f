"""Where everything is in an edited drive, frame by frame, as other programs read it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from drivesplat.editing.cast import Role
from drivesplat.motion import Motion
from drivesplat.regions import is_dynamic
from drivesplat.scene import Scene


def track_labels(scene: Scene, roles: Sequence[Role], actors: set[str], seconds: np.ndarray) -> list[dict[str, Any]]:
    """A record for every role, and for everything else that is annotated and can move: that is part of what stands
    still in the model, or of its ghosts, and stays as it was recorded. `actors`: the ids of all that can be edited,
    removed ones included; `seconds` (n,) one a frame.

    `object_to_world` (n times 4, 4) is at the box's centre, None in frames in which the object is absent.
    """
    played = [
        {
            "id": role.id,
            "source": role.source,
            "category": role.category,
            "size": role.size.tolist(),
            "scale": role.scale,
            "edited": role.edited,
            "editable": True,
            "object_to_world": _frames(role, seconds),
        }
        for role in roles
    ]
    recorded = [
        {
            "id": track.id,
            "source": track.id,
            "category": track.category,
            "size": track.size.tolist(),
            "scale": 1.0,
            "edited": False,
            "editable": False,
            "object_to_world": _frames(Motion.of_track(scene, track), seconds),
        }
        for track in scene.tracks
        if is_dynamic(track.category) and track.id not in actors
    ]
    return played + recorded


def _frames(moving: Role | Motion, seconds: np.ndarray) -> list[list[list[float]] | None]:
    there, poses = moving.present(seconds), moving.poses(seconds)
    return [pose.tolist() if now else None for now, pose in zip(there, poses, strict=True)]
