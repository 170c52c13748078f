"""The street after an edit: the same steps that edit a trained model move, remove and copy its objects.

In the truth of an edit every object is there at all times; a recorded track ends where nobody annotates it any more.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from drivesplat.readers.nuscenes.object_classes import object_class
from drivesplat.settings.edit import Edit
from drivesplat.trajectories.edited_actors import EditedActor, Insertable, edited_actors
from drivesplat.trajectories.ego_path import edited_poses
from drivesplat.trajectories.lateral_offset import PosesAt
from drivesplat.trajectories.motion import Motion
from drivesplat.world.shapes.body import RigidBody
from drivesplat.world.street.objects import EGO_PARTS, StreetObject
from drivesplat.world.street.paths import GivenPath
from drivesplat.world.street.street import Street
from drivesplat.world.tokens import instance_token

MOTION_HZ = 20.0
"""Poses a second through which the splines of an edited path lead."""
NOTHING_INSERTED: Mapping[str, StreetObject] = MappingProxyType({})
MARGIN = 1.0
"""Seconds before and after the drive that they cover."""


@dataclass(frozen=True)
class Variation:
    """A street, and the true ego poses where they differ from its ego path."""

    street: Street
    ego_poses_at: PosesAt | None = None

    def ego_poses(self, seconds: np.ndarray) -> np.ndarray:
        """Ego to street (n, 4, 4) at `seconds` (n,) from the first key frame."""
        return (self.ego_poses_at or self.street.ego.poses)(seconds)


def edited(
    street: Street, scene: str, edit: Edit, name: str, seconds: float, film_start: float,
    inserted: Mapping[str, StreetObject] = NOTHING_INSERTED,
) -> Variation:  # fmt: skip
    """The street of the drive `scene`, `seconds` long, after the edit `name`. Tracks have the ids of the tables.
    `inserted` are objects of other streets by the names of their assets in the edit.

    Second 0 of edits is the first image, `film_start` seconds after the first key frame. Raises ConfigError, one line,
    if a step names an unknown track, changes nothing or contradicts an earlier one.
    """
    by_id = {instance_token(scene, item.name): item for item in street.objects if item.category}
    editable = {
        id: item
        for id, item in by_id.items()
        if isinstance(item.body, RigidBody) and (item.category or "").startswith("vehicle.")
    }
    times = np.linspace(-MARGIN, seconds + MARGIN, round((seconds + 2 * MARGIN) * MOTION_HZ) + 1)
    motions = {
        id: Motion(times - film_start, item.box_poses(times), ((0, len(times) - 1),), 0.5 / MOTION_HZ)
        for id, item in editable.items()
    }
    actors = [
        EditedActor.recorded(id, object_class(item.category or ""), item.category or "", item.size, motions[id])
        for id, item in editable.items()
    ]
    ego = street.ego.poses(np.arange(0.0, seconds, 0.1) + film_start)
    where, others = f"scene {scene}, edit {name!r}", by_id.keys() - editable.keys()
    insertable = {
        name: Insertable(object_class(item.category or ""), item.category or "", item.size, np.zeros(0))
        for name, item in inserted.items()
    }
    changed = edited_actors(actors, edit, where, others, ego, insertable)
    objects = [_object_of(actor, {**editable, **inserted}, film_start) for actor in changed]
    steps = [step.ego for step in edit.steps if step.ego is not None]

    def recorded(film: np.ndarray) -> np.ndarray:
        return street.ego.poses(film + film_start)

    def moved(seconds: np.ndarray) -> np.ndarray:
        return edited_poses(recorded, steps, 0.0, seconds - film_start)

    ego_poses = moved if steps else street.ego.poses
    kept = [item for item in street.objects if item not in editable.values()]
    carried = [replace(item, path=GivenPath(ego_poses)) if item.name in EGO_PARTS else item for item in kept]
    objects = sorted((*carried, *objects), key=lambda item: item.moves)
    return Variation(replace(street, objects=tuple(objects)), ego_poses)


def _object_of(actor: EditedActor, originals: Mapping[str, StreetObject], film_start: float) -> StreetObject:
    """The object of an actor; one that the edit leaves alone is the original."""
    original = originals[actor.source]
    if not actor.edited:
        return original

    def poses_at(seconds: np.ndarray) -> np.ndarray:
        poses = actor.poses(seconds - film_start)
        poses[:, :3, 3] -= poses[:, :3, 2] * actor.size[2] / 2
        return poses

    name = originals[actor.id].name if actor.id in originals else actor.id
    if not isinstance(original.body, RigidBody):  # of an inserted person or cyclist; steps do not change its looks
        return replace(original, name=name, path=GivenPath(poses_at))
    mesh = original.body.pieces[0].scaled(actor.scale)
    body = RigidBody(mesh if actor.color_matrix is None else mesh.recolored(actor.color_matrix))
    return replace(original, name=name, body=body, path=GivenPath(poses_at))
