"""Per-frame poses of all objects in an edited drive, as a record for other programs."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from drivesplat.editing.edited_actors import EditedActor
from drivesplat.scene.motion import Motion
from drivesplat.scene.scene import Scene, Track

DECIMALS = 6
"""Decimals of a pose: micrometres, and 1e-4 degrees. More would double the size of the file."""


def track_labels(
    scene: Scene, actors: Sequence[EditedActor], editable: set[str], seconds: np.ndarray
) -> list[dict[str, Any]]:
    """A record for every actor, then for every other annotated movable object, which stays as recorded: the model has
    it in its static part. `editable`: the ids of all editable tracks, removed ones included; `seconds` (n,) of frames.

    `size` is length, width, height in metres, `scale` included; `object_to_world` (n times (4, 4)) is at the box
    centre, rounded to 1e-6, None in frames where the object is absent.
    """
    others = (track for track in scene.tracks if track.object_class.is_dynamic and track.id not in editable)
    return [*(_edited(actor, seconds) for actor in actors), *(_recorded(scene, track, seconds) for track in others)]


def _edited(actor: EditedActor, seconds: np.ndarray) -> dict[str, Any]:
    known = {"source": actor.source, "scale": actor.scale, "edited": actor.edited, "editable": True}
    return {**_annotation(actor), **known, "object_to_world": _poses(actor, seconds)}


def _recorded(scene: Scene, track: Track, seconds: np.ndarray) -> dict[str, Any]:
    known = {"source": track.id, "scale": 1.0, "edited": False, "editable": False}
    return {**_annotation(track), **known, "object_to_world": _poses(Motion.of_track(scene, track), seconds)}


def _annotation(item: EditedActor | Track) -> dict[str, Any]:
    return {"id": item.id, "category": item.category, "size": item.size.tolist()}


def _poses(item: EditedActor | Motion, seconds: np.ndarray) -> list[list[list[float]] | None]:
    present, poses = item.present(seconds), item.poses(seconds).round(DECIMALS)
    return [pose.tolist() if now else None for now, pose in zip(present, poses, strict=True)]
