"""The edits of a scene for programs that play them: samples of every object and of the camera."""

import logging
from collections.abc import Mapping

import numpy as np

from drivesplat.editing.actors import edited_model
from drivesplat.editing.ego import edited_camera_path
from drivesplat.errors import ConfigError
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.scene.scene import Scene
from drivesplat.settings.edit import Edit
from drivesplat.trajectories.camera_path import sampled_path
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.sampled_edit import CameraMotion, Instance, InstanceMotion, SampledEdit

log = logging.getLogger(__name__)


def sampled_edits(
    checkpoint: TrainedCheckpoint, scene: Scene, camera: str, edits: Mapping[str, Edit], rate: int
) -> list[SampledEdit]:
    """The edits of a trained scene, sampled `rate` times a second and at the images of a camera.

    An edit that does not fit the scene or the model, or inserts an asset, is left out with a warning.
    """
    if not edits:
        return []
    drives, model = [], trained_model(checkpoint)
    for name, edit in edits.items():
        where, moved = f"scene {scene.name}, edit {name!r}", None
        if any(step.insert is not None for step in edit.steps):
            log.warning("%s: it is left out, since the page has no Gaussians of inserted assets", where)
            continue
        try:
            edited = edited_model(model, scene, camera, edit, where).actors
            if any(step.kind == "ego" for step in edit.steps):
                path = edited_camera_path(scene, camera, rate, edit, where)
                times = np.array([scene.seconds(timestamp) for timestamp in path.timestamps])
                moved = CameraMotion(times, path.camera_to_world)
        except ConfigError as error:
            log.warning("an edit is left out: %s", error)
            continue
        timestamps, _ = sampled_path(scene, camera, rate)
        seconds = np.array([scene.seconds(timestamp) for timestamp in timestamps])
        instances = tuple(
            Instance(
                actor.id, actor.source, actor.category, actor.size, actor.scale,
                _sampled_actor(actor, seconds) if actor.edited else None,
                actor.color_matrix, actor.phase,
            )
            for actor in edited
        )  # fmt: skip
        drives.append(SampledEdit(name, instances, moved))
    return drives


def _sampled_actor(actor: EditedActor, seconds: np.ndarray) -> InstanceMotion:
    """The motion of an edited actor at those of `seconds` (n,) at which it is present. Its spans run from the first to
    the last of neighbouring ones."""
    present = actor.present(seconds)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(int)))
    spans = tuple((float(seconds[first]), float(seconds[after - 1])) for first, after in edges.reshape(-1, 2))
    shown = seconds[present]
    if not len(shown):
        return InstanceMotion(shown, np.zeros((0, 4, 4)), np.zeros(0), spans)
    return InstanceMotion(shown, actor.poses(shown), actor.walked(shown), spans)
