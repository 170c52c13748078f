"""The stage `edit`: a drive that was never driven, as a film with the recorded one beside it, and as labels."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.editing.cast import Actor, Role, edited_cast
from drivesplat.editing.ego import edited_camera_path
from drivesplat.editing.labels import track_labels
from drivesplat.errors import ConfigError, ResultError
from drivesplat.model.checkpoint import open_model
from drivesplat.model.part import ActorPlacement
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.film import Shot, recorded_shot, write_film
from drivesplat.rendering.frames import film_frames
from drivesplat.rendering.trajectory import CameraPath, film_path
from drivesplat.scene.images import write_png
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import EditJob, TrajectorySettings

log = logging.getLogger(__name__)

NEAR = 0.5
"""Metres from a box within which a camera sees little but what is in it."""


@dataclass(frozen=True)
class EditFiles:
    """What an edit writes: the film, and a still of it; frames, if wanted, into the folder of the film's name."""

    film: Path
    still: Path

    @property
    def frames(self) -> Path:
        return self.film.with_suffix("")


def render_edit(
    scene: Scene, checkpoint: dict[str, Any], job: EditJob, device_settings: DeviceSettings, files: EditFiles
) -> dict[str, Any]:
    """Writes the film and the still, both with the recorded drive on the left and the edited one on the right, and the
    frames of the edited one, if wanted; returns the content of the edit's JSON, provenance aside: the cameras of the
    edited drive, at the size of the frames, and where everything is in it.

    `checkpoint` is the content of checkpoint.pt. Raises ConfigError where the edit does not fit the scene or the model
    has no actors; DatasetError, DeviceError and ResultError as films do.
    """
    model, device = open_model(checkpoint, device_settings)
    where = f"scene {scene.name}, edit {files.film.stem!r}"
    actors = actors_of(model, scene, where)
    others = {track.id for track in scene.tracks} - {actor.id for actor in actors}
    roles = edited_cast(actors, job.edit, where, others)
    path = edited_camera_path(scene, job.camera, job.fps, job.edit, where)
    recorded = film_path(scene, job.camera, job.fps, TrajectorySettings())[: len(path)]
    left, right = (Shot(scene, cameras, job, job.tile(2)) for cameras in (recorded, path))
    large = Shot(scene, path, job, (job.width, job.height))
    seconds = np.array([scene.seconds(timestamp) for timestamp in path.timestamps])
    crashed = crashes(roles, path, seconds)
    if crashed.any():
        first, last = seconds[crashed][[0, -1]]
        log.warning("%s: the camera is inside a vehicle between %.1f and %.1f s", where, first, last)
    present, still = actor_placements(roles, seconds), Still(crashed)
    before = recorded_shot(model, left, device)
    model.precompute(right.seconds)
    after = edited_frames(model, right.views(device), present)
    write_film(files.film, still.side_by_side(before, after), right, model, columns=2)
    write_png(files.still, still.picture)
    remove_frames(files.frames)
    images = write_frames(files.frames, edited_frames(model, large.views(device), present)) if job.frames else []
    return {
        **large.record(),
        "edit": job.edit.model_dump(mode="json"),
        "still_frame": still.number,
        "images": images,
        "tracks": track_labels(scene, roles, {actor.id for actor in actors}, seconds),
    }


def actors_of(model: SplatModel, scene: Scene, where: str) -> list[Actor]:
    """Who can be edited: the objects that the model knows, as it has come to know their motion.

    `where` begins messages. Raises ConfigError where it knows none, ResultError where the scene lacks one.
    """
    actors = []
    for name, group in model.rigid_groups(0.0).items():
        track = scene.track(name)
        if group.motion is None:
            continue
        if track is None:
            raise ResultError(
                f"{where}: scene.json has no track {name}, which checkpoint.pt knows; delete it and rerun"
            )
        actors.append(Actor(track.id, track.category, track.size, group.motion))
    if not actors:
        raise ConfigError(
            f"{where}: nothing can be edited, since this method's model knows no actors; "
            "train one with the part 'actors' (the method 'street'), on a scene in which something moves"
        )
    return actors


def actor_placements(roles: Sequence[Role], seconds: np.ndarray) -> list[list[ActorPlacement]]:
    """The placements of all present objects at each of `seconds` (n,)."""
    entries: list[list[ActorPlacement]] = [[] for _ in seconds]
    for role in roles:
        poses = role.poses(seconds) if role.edited else None
        for number in np.flatnonzero(role.present(seconds)):
            pose = poses[number] if poses is not None else None
            entries[number].append(ActorPlacement(role.source, pose, role.scale))
    return entries


def crashes(roles: Sequence[Role], path: CameraPath, seconds: np.ndarray) -> np.ndarray:
    """In which frames (n,) bool the camera is in the box of an object, or nearer to it than NEAR: its picture is then
    of that object's inside."""
    inside = np.zeros(len(seconds), dtype=bool)
    for role in roles:
        to_object = inverse(role.poses(seconds))
        camera = (to_object[:, :3, :3] @ path.camera_to_world[:, :3, 3:])[..., 0] + to_object[:, :3, 3]
        inside |= role.present(seconds) & (np.abs(camera) < role.size / 2 + NEAR).all(axis=1)
    return inside


def edited_frames(
    model: SplatModel, views: Iterable[View], present: Iterable[Sequence[ActorPlacement]]
) -> Iterator[np.ndarray]:
    """Renders each view with the objects at their placements of that time: (h, w, 3) uint8 each."""
    pairs = zip(views, present, strict=True)
    return film_frames(model, ((view, model.gaussians_with_placements(view.time, shown)) for view, shown in pairs))


class Still:
    """Of the pairs of a recorded and an edited frame that went by the one whose frames differ most, `spoilt` (n,) bool
    ones only where there is no other: its `number`, counted from 0, and `picture`, both side by side."""

    number: int
    picture: np.ndarray

    def __init__(self, spoilt: np.ndarray):
        self._spoilt = spoilt

    def side_by_side(self, recorded: Iterable[np.ndarray], edited: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        """The pairs, each as one picture."""
        most = (False, -1.0)
        for number, pair in enumerate(zip(recorded, edited, strict=True)):
            picture, difference = np.hstack(pair), float(np.abs(np.subtract(*pair, dtype=np.int16)).mean())
            worth = (not self._spoilt[number], difference)
            if worth > most:
                most, self.number, self.picture = worth, number, picture
            yield picture


def write_frames(folder: Path, frames: Iterable[np.ndarray]) -> list[str]:
    """Writes frames (h, w, 3) uint8 as PNGs into `folder`; returns their paths from the folder above it."""
    folder.mkdir(exist_ok=True)
    names = []
    for number, frame in enumerate(frames):
        names.append(f"{folder.name}/{number:06d}.png")
        write_png(folder.parent / names[-1], frame)
    return names


def remove_frames(folder: Path) -> None:
    """Removes the frames that an earlier run wrote into `folder`, and it, if nothing else is in it."""
    for file in folder.glob("[0-9]" * 6 + ".png"):
        file.unlink()
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
