"""The actors of a trained model that edits change."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivesplat.editing.assets.asset import NO_INSERTS, Inserts
from drivesplat.editing.assets.ground import ground_color, matching_gains
from drivesplat.editing.assets.inserted import with_assets
from drivesplat.errors import ConfigError, ResultError
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.light import Shade
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Scene
from drivesplat.settings.edit import Edit, Insert
from drivesplat.trajectories.camera_path import recorded_frames
from drivesplat.trajectories.edited_actors import EditedActor, Insertable, edited_actors
from drivesplat.trajectories.motion import Motion

log = logging.getLogger(__name__)

ALL_AROUND = np.radians(np.arange(0.0, 360.0, 10.0))
"""The directions from which an asset of unknown origin was seen."""
MATCHED_S = 20.0
"""Seconds from its first on in the middle of which the colours of an inserted object are matched."""
COLLISION_MARGIN = 0.5
"""Metres around a box within which a camera sees little but the inside of the object."""


@dataclass(frozen=True, eq=False)
class EditedModel:
    """A model after an edit: the `model` with the assets that the edit inserts, its actors as `recorded`, and the
    `actors` after the edit."""

    model: SplatModel
    recorded: list[EditedActor]
    actors: list[EditedActor]


def edited_model(
    model: SplatModel, scene: Scene, camera: str, edit: Edit, where: str, inserts: Inserts = NO_INSERTS
) -> EditedModel:
    """A model after an edit, whose steps insert `inserts`. Steps that place an object count from the ego poses
    at the images of `camera`.

    Raises ConfigError, starting with `where`, if the edit does not fit the scene or the model has no actors;
    DatasetError if the scene lacks the camera; ResultError as `editable_actors`.
    """
    inserting = any(step.insert is not None for step in edit.steps)
    recorded = (trained_actors if inserting else editable_actors)(model, scene, where)
    others = {track.id for track in scene.tracks} - {actor.id for actor in recorded}
    ego_to_world = np.stack([frame.ego_to_world for frame in recorded_frames(scene, camera)])
    insertable = {
        name: Insertable(asset.object_class, asset.category, asset.size, asset.seen if len(asset.seen) else ALL_AROUND)
        for name, asset in inserts.assets.items()
    }
    actors = edited_actors(recorded, edit, where, others, ego_to_world, insertable)
    steps = [step.insert for step in edit.steps if step.insert is not None]
    lit = {**{step.asset: step for step in steps}, **{step.name: step for step in steps}}  # copies as their asset
    actors = [
        actor if actor.seen is None else _as_it_is_lit(model, actor, lit.get(actor.id, lit[actor.source]), inserts)
        for actor in actors
    ]
    used = {actor.source for actor in actors}
    whole = with_assets(model, {name: asset for name, asset in inserts.assets.items() if name in used})
    return EditedModel(whole, recorded, actors)


def _as_it_is_lit(model: SplatModel, actor: EditedActor, step: Insert, inserts: Inserts) -> EditedActor:
    """An inserted actor with its shadow, and with colours as bright as its place in the middle of its presence."""
    if step.shadow:
        actor = replace(actor, shade=Shade(actor.size, inserts.light))
    if step.match_exposure:
        first = max(actor.path.begin, 0.0)
        middle = 0.5 * (first + max(first, min(actor.path.end, first + MATCHED_S)))
        here = ground_color(model, middle, actor.poses(np.array([middle]))[0], float(actor.size[2]))
        gains = matching_gains(inserts.assets[step.asset].ground, here)
        if gains is not None:
            own = np.eye(3) if actor.color_matrix is None else actor.color_matrix
            actor = replace(actor, color_matrix=own @ np.diag(gains))
    return actor


def editable_actors(model: SplatModel, scene: Scene, where: str) -> list[EditedActor]:
    """The actors of the model, with their motion as trained.

    Messages start with `where`. Raises ConfigError if there are none, ResultError if the scene lacks one of them.
    """
    actors = trained_actors(model, scene, where)
    if not actors:
        raise ConfigError(
            f"{where}: nothing can be edited, since the model of this method has no actors; "
            "train one with the part 'actors' (the method 'street') on a scene with moving vehicles"
        )
    return actors


def trained_actors(model: SplatModel, scene: Scene, where: str) -> list[EditedActor]:
    """As `editable_actors`, without the ConfigError: a model may have none."""
    actors = []
    for name, group in model.rigid_groups(0.0).items():
        track = scene.track(name)
        if group.motion is None:
            continue
        if track is None:
            raise ResultError(
                f"{where}: scene.json has no track {name}, which checkpoint.npz contains; delete that file and rerun"
            )
        actors.append(EditedActor.recorded(track.id, track.object_class, track.category, track.size, group.motion))
    return actors


def other_objects(scene: Scene, actors: Iterable[EditedActor]) -> list[EditedActor]:
    """The annotated objects that are none of `actors`, as recorded: the model has them in its static part."""
    ids = {actor.id for actor in actors}
    others = (track for track in scene.tracks if track.id not in ids)
    return [EditedActor.recorded(t.id, t.object_class, t.category, t.size, Motion.of_track(scene, t)) for t in others]


def warn_of_collisions(
    actors: Sequence[EditedActor], sensor_to_world: np.ndarray, seconds: np.ndarray, where: str, sensor: str = "camera"
) -> np.ndarray:
    """The times (n,) bool at which a sensor is inside a box enlarged by COLLISION_MARGIN, and so shows the inside of an
    object; warns, beginning with `where`, if there are any."""
    inside = np.zeros(len(seconds), dtype=bool)
    for actor in actors:
        to_object = inverse(actor.poses(seconds))
        place = (to_object[:, :3, :3] @ sensor_to_world[:, :3, 3:])[..., 0] + to_object[:, :3, 3]
        inside |= actor.present(seconds) & (np.abs(place) < actor.size / 2 + COLLISION_MARGIN).all(axis=1)
    if inside.any():
        first, last = seconds[inside][[0, -1]]
        log.warning("%s: the %s is inside a vehicle between %.1f and %.1f s", where, sensor, first, last)
    return inside
