"""The stage `edit`: a drive that was never driven, as a film with the recorded one beside it, and as labels."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.editing.cast import Actor, Role, edited_cast
from drivesplat.editing.ego import edited_camera_path
from drivesplat.editing.labels import track_labels
from drivesplat.errors import ConfigError
from drivesplat.film import Shot, film_frame, write_film
from drivesplat.images import write_png
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.part import Appearance
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import EditJob, TrajectorySettings
from drivesplat.training.run import open_model
from drivesplat.trajectory import film_path


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
    """Writes the film and the still, both with the recorded drive on the left and the edited one on the right; returns
    the content of the edit's JSON, provenance aside: the cameras of the edited drive, and its tracks.

    `checkpoint` is the content of checkpoint.pt. Raises ConfigError where the edit does not fit the scene or the model
    has no actors; DatasetError, DeviceError and ResultError as films do.
    """
    model, device = open_model(checkpoint, device_settings)
    actors = actors_of(model, scene)
    roles = edited_cast(actors, job.edit, f"scene {scene.name}, edit {files.film.stem!r}")
    path = edited_camera_path(scene, job.camera, job.fps, job.edit)
    recorded = film_path(scene, job.camera, job.fps, TrajectorySettings())[: len(path)]
    seconds = np.array([scene.seconds(timestamp) for timestamp in path.timestamps])
    stage, still = Stage(model, appearances(roles, seconds), seconds), Still()
    shots = Shot(scene, recorded, job, job.tile(2)), Shot(scene, path, job, job.tile(2))
    large = Shot(scene, path, job, (job.width, job.height))
    write_film(files.film, _pairs(stage, shots, still, device), shots[1], len(model), columns=2)
    write_png(files.still, np.hstack(still.pair))
    remove_frames(files.frames)
    images = write_frames(files.frames, stage, large, device) if job.frames else []
    return {
        **large.record(),
        "edit": job.edit.model_dump(mode="json"),
        "still_frame": still.number,
        "images": images,
        "tracks": track_labels(scene, roles, {actor.id for actor in actors}, seconds),
    }


def actors_of(model: SplatModel, scene: Scene) -> list[Actor]:
    """Who can be edited: the objects that the model knows, as it has come to know their motion.

    Raises ConfigError where it knows none.
    """
    moving = {name: piece.motion for name, piece in model.pieces(0.0).items() if piece.motion is not None}
    known = ((scene.track(name), motion) for name, motion in moving.items())
    actors = [Actor(track.id, track.category, track.size, motion) for track, motion in known if track is not None]
    if not actors:
        raise ConfigError(
            f"scene {scene.name}: nothing can be edited, since this method's model knows no actors; "
            "train one with the part 'actors' (the method 'street'), on a scene in which something moves"
        )
    return actors


def appearances(roles: Sequence[Role], seconds: np.ndarray) -> list[list[Appearance]]:
    """Who appears where at each of `seconds` (n,)."""
    entries: list[list[Appearance]] = [[] for _ in seconds]
    for role in roles:
        poses = role.poses(seconds) if role.edited else None
        for number in np.flatnonzero(role.present(seconds)):
            pose = poses[number] if poses is not None else None
            entries[number].append(Appearance(role.source, pose, role.scale))
    return entries


@dataclass(frozen=True)
class Stage:
    """A model with what appears in each frame, at `seconds` (n,)."""

    model: SplatModel
    appearances: Sequence[Sequence[Appearance]]
    seconds: np.ndarray

    @torch.no_grad()
    def gaussians(self, number: int) -> Gaussians:
        """What is there in a frame, in world coordinates."""
        return self.model.staged_at(float(self.seconds[number]), self.appearances[number])


@dataclass
class Still:
    """Of the pairs of recorded and edited picture that it has seen the one that differs most, and its number."""

    number: int = 0
    pair: tuple[np.ndarray, ...] = ()
    _difference: float = -1.0

    def look(self, number: int, pair: tuple[np.ndarray, ...]) -> None:
        left, right = (picture.astype(np.int16) for picture in pair)
        difference = float(np.abs(left - right).mean())
        if difference > self._difference:
            self.number, self.pair, self._difference = number, pair, difference


def _pairs(stage: Stage, shots: Sequence[Shot], still: Still, device: torch.device) -> Iterator[np.ndarray]:
    """The recorded and the edited drive side by side, frame by frame."""
    for number, (recorded, edited) in enumerate(zip(*(shot.views(device) for shot in shots), strict=True)):
        pair = film_frame(stage.model, recorded), film_frame(stage.model, edited, stage.gaussians(number))
        still.look(number, pair)
        yield np.hstack(pair)


def write_frames(folder: Path, stage: Stage, shot: Shot, device: torch.device) -> list[str]:
    """Writes every frame of the edited drive as PNG into `folder`; returns their paths from the folder above it."""
    folder.mkdir(exist_ok=True)
    names = [f"{folder.name}/{number:06d}.png" for number in range(len(stage.seconds))]
    for number, view in enumerate(shot.views(device)):
        write_png(folder.parent / names[number], film_frame(stage.model, view, stage.gaussians(number)))
    return names


def remove_frames(folder: Path) -> None:
    """Removes the frames that an earlier run wrote into `folder`, and it, if nothing else is in it."""
    for file in folder.glob("[0-9]" * 6 + ".png"):
        file.unlink()
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
