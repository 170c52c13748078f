"""Where everything is in an edited drive, frame by frame, as other programs read it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from drivesplat.editing.cast import Role
from drivesplat.scene.motion import Motion
from drivesplat.scene.scene import Scene, Track

DECIMALS = 6
"""Of a pose: micrometres, and ten thousandths of a degree. More would double the file."""


def track_labels(scene: Scene, roles: Sequence[Role], actors: set[str], seconds: np.ndarray) -> list[dict[str, Any]]:
    """A record for every role, and for everything else that is annotated and can move: that is part of what stands
    still in the model, or of its ghosts, and stays as it was recorded. `actors`: the ids of all that can be edited,
    removed ones included; `seconds` (n,) one a frame.

    `size` is length, width, height in metres, `scale` included; `object_to_world` (n times 4, 4) is at the box's
    centre, to a millionth, None in frames in which the object is absent.
    """
    others = (track for track in scene.tracks if track.object_class.is_dynamic and track.id not in actors)
    return [*(_played(role, seconds) for role in roles), *(_recorded(scene, track, seconds) for track in others)]


def _played(role: Role, seconds: np.ndarray) -> dict[str, Any]:
    known = {"source": role.source, "scale": role.scale, "edited": role.edited, "editable": True}
    return {**_annotation(role), **known, "object_to_world": _frames(role, seconds)}


def _recorded(scene: Scene, track: Track, seconds: np.ndarray) -> dict[str, Any]:
    known = {"source": track.id, "scale": 1.0, "edited": False, "editable": False}
    return {**_annotation(track), **known, "object_to_world": _frames(Motion.of_track(scene, track), seconds)}


def _annotation(it: Role | Track) -> dict[str, Any]:
    return {"id": it.id, "category": it.category, "size": it.size.tolist()}


def _frames(it: Role | Motion, seconds: np.ndarray) -> list[list[list[float]] | None]:
    there, poses = it.present(seconds), it.poses(seconds).round(DECIMALS)
    return [pose.tolist() if now else None for now, pose in zip(there, poses, strict=True)]
