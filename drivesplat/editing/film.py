"""The stage `edit`: an edited drive as a film beside the recorded one, and as labels."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.editing.actors import edited_model, other_objects, warn_of_collisions
from drivesplat.editing.assets.asset import NO_INSERTS, Inserts
from drivesplat.editing.ego import edited_camera_path
from drivesplat.editing.placed_model import placed_models
from drivesplat.editing.shown_objects import ShownObjects
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.film import Shot, recorded_shot, shot_of, write_film
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.rendering.frames import film_frames
from drivesplat.rendering.panels import Panels
from drivesplat.scene.images import write_png
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.render import RECORDED_IN_WORDS, EditJob, TrajectorySettings
from drivesplat.trajectories.camera_path import film_path
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.seen_sides import TimedCameras

log = logging.getLogger(__name__)

DECIMALS = 6
"""Decimals of a pose in labels: micrometres, and 1e-4 degrees. More would double the size of the file."""
SHOWN_EVERY_S = 0.5
"""Seconds between the frames in which labels look for the objects that the background shows."""
UNSEEN = "sides that no camera saw"
"""The note in the film, for frames of `unseen_sides`."""
MAX_TURN = np.radians(40.0)
"""An object seen from farther round than this from all directions in training shows a side that is not there."""
MIN_SHARE_SHOWN = 0.05
"""Height of an object as a share of the frame's height from which a frame counts."""


@dataclass(frozen=True)
class EditFiles:
    """The outputs of an edit: the film and a still of it; optional frames go into the folder of the film's name."""

    film: Path
    still: Path

    @property
    def frames(self) -> Path:
        return self.film.with_suffix("")


def render_edit(
    scene: Scene,
    checkpoint: TrainedCheckpoint,
    job: EditJob,
    device_settings: DeviceSettings,
    files: EditFiles,
    inserts: Inserts = NO_INSERTS,
    frames_file: Path | None = None,
) -> dict[str, Any]:
    """Writes the film and the still, both with the recorded and the edited drive in panels, and, if `job.frames`, the
    frames of the edited one. `inserts` is what the edit inserts; `frames_file` is the file of
    `write_recorded_frames`; without it these frames are rendered.

    Returns the content of the edit's JSON without provenance: the cameras of the edited drive at the size of a frame,
    which is that of a panel, the places of the panels in the `film`, and the poses of all objects. Raises ConfigError
    if the edit does not fit the scene or the model has no actors; DatasetError, DeviceError and ResultError as
    `render_film` does.
    """
    model, device = open_model(checkpoint, device_settings)
    where = f"scene {scene.name}, edit {files.film.stem!r}"
    drive = edited_shots(scene, model, job, where, inserts)
    after, seconds = drive.after, np.array(drive.after.seconds)
    colliding = warn_of_collisions(drive.actors, after.cameras.camera_to_world, seconds, where)
    panels = Panels(("recorded", files.film.stem), after.size)
    still = Still(panels, avoided=colliding | (seconds > after.trained_until))
    shown = recorded_shot(model, drive.before, device, frames_file)
    changed = edited_frames(drive.model, after.views(device), drive.actors, seconds)
    for file in files.frames.glob("[0-9]" * 6 + ".png"):  # of an earlier run
        file.unlink()
    if files.frames.is_dir() and not any(files.frames.iterdir()):
        files.frames.rmdir()
    if job.frames:
        changed = written_frames(files.frames, changed)
    labels = [RECORDED_IN_WORDS, f"edited: {files.film.stem}"]
    write_film(files.film, still.pairs(shown, changed), after, model, panels, drive.notes, labels)
    write_png(files.still, still.picture)
    dynamic = {track.id for track in scene.tracks if track.object_class.is_dynamic}
    others = [item for item in other_objects(scene, drive.recorded) if item.id in dynamic]
    objects = ShownObjects.of_scene(scene, drive.model, drive.actors, others)
    apart = max(1, round(SHOWN_EVERY_S * job.fps))
    images = [frame_name(files.frames, number) for number in range(len(after.cameras))] if job.frames else []
    return {
        **after.record(),
        "film": panels.record(),
        "edit": job.edit.model_dump(mode="json"),
        "still_frame": still.number,
        "images": images,
        "tracks": track_labels(objects, seconds, islice(after.views(device), 0, None, apart)),
    }


@dataclass(frozen=True)
class EditedShots:
    """A drive with an edit: the `model` with the assets that the edit inserts, its actors as `recorded` and as edited
    (`actors`), and shots of the same times `before` the edit and `after` it."""

    model: SplatModel
    recorded: Sequence[EditedActor]
    actors: Sequence[EditedActor]
    before: Shot
    after: Shot

    @property
    def notes(self) -> list[str]:
        """The note in the caption of each edited frame."""
        return [UNSEEN if unseen else "" for unseen in unseen_sides(self.recorded, self.actors, self.after)]


def unseen_sides(recorded: Sequence[EditedActor], edited: Sequence[EditedActor], shot: Shot) -> np.ndarray:
    """The frames (n,) bool of a shot that show one of the `edited` actors from a side that no training image shows;
    `recorded` are the actors before the edit, and assets that it inserts have `seen`. Objects that hide each other are
    not accounted for."""
    trained, count = TimedCameras.of_training(shot.scene, shot.format.holdout), len(shot.cameras)
    repeated = np.tile(shot.K, (count, 1, 1)), np.tile(shot.size, (count, 1))
    filmed = TimedCameras(np.array(shot.seconds), shot.cameras.camera_to_world, *repeated)
    known = {actor.id: trained.azimuths(actor) for actor in recorded}
    found = np.zeros(count, dtype=bool)
    for actor in edited:
        azimuths = filmed.azimuths(actor, MIN_SHARE_SHOWN)
        seen = known[actor.source] if actor.seen is None else actor.seen
        turns = np.abs(np.angle(np.exp(1j * (azimuths[:, None] - seen[~np.isnan(seen)]))))
        found |= ~np.isnan(azimuths) & (turns.min(axis=1, initial=np.pi) > MAX_TURN)
    return found


def edited_shots(
    scene: Scene, model: SplatModel, job: EditJob, where: str, inserts: Inserts = NO_INSERTS
) -> EditedShots:
    """The drive with the edit of `job`, which inserts `inserts`. Raises ConfigError, starting with `where` (the
    scene and the edit), if the edit does not fit the scene or the model has no actors, DatasetError if the scene lacks
    the camera."""
    edited = edited_model(model, scene, job.camera, job.edit, where, inserts)
    path = edited_camera_path(scene, job.camera, job.fps, job.edit, where)
    unedited = film_path(scene, job.camera, job.fps, TrajectorySettings())[: len(path)]
    before, after = (shot_of(scene, cameras, job) for cameras in (unedited, path))
    if len(after.cameras) < len(path):
        warn_of_late_steps(job.edit, after.seconds[-1], where)
    return EditedShots(edited.model, edited.recorded, edited.actors, before, after)


def warn_of_late_steps(edit: Edit, end: float, where: str) -> None:
    """Warns, beginning with `where`, of every step that changes nothing until the film's `end` in seconds."""
    for number, step in enumerate(edit.steps, start=1):
        if step.begins >= end:
            log.warning(
                "%s, step %d (%s): it begins at %.1f s, after the film's end at %.1f s, where training images end; "
                "render: {end: recorded} shows it",
                where, number, step.kind, step.begins, end,
            )  # fmt: skip


def edited_frames(
    model: SplatModel, views: Iterable[View], actors: Sequence[EditedActor], seconds: np.ndarray
) -> Iterator[np.ndarray]:
    """The rendering of each view, of `seconds` (n,), with the actors as they then are, (h, w, 3) uint8 each."""
    fixed = FixedModel(model)
    pairs = zip(views, placed_models(fixed, actors, seconds), strict=True)
    return film_frames(fixed, ((view, placed.sets_in(view)) for view, placed in pairs))


class Still:
    """The pair of a recorded and an edited frame that differ most: its `number` from 0 and `picture` of `panels`.
    `avoided` (n,) bool frames are chosen only if there is no other: those inside a vehicle, and those beyond the last
    training image."""

    number: int
    picture: np.ndarray

    def __init__(self, panels: Panels, avoided: np.ndarray):
        self._panels, self._avoided = panels, avoided

    def pairs(self, recorded: Iterable[np.ndarray], edited: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        """Yields each pair as one picture."""
        best = (False, -1.0)
        for number, pair in enumerate(zip(recorded, edited, strict=True)):
            picture, difference = self._panels.assembled(pair), float(np.abs(np.subtract(*pair, dtype=np.int16)).mean())
            score = (not self._avoided[number], difference)
            if score > best:
                best, self.number, self.picture = score, number, picture
            yield picture


def written_frames(folder: Path, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The frames (h, w, 3) uint8, each after it has been written as a PNG into `folder`."""
    folder.mkdir(exist_ok=True)
    for number, frame in enumerate(frames):
        write_png(folder.parent / frame_name(folder, number), frame)
        yield frame


def frame_name(folder: Path, number: int) -> str:
    """The path of a frame's PNG in `folder`, relative to its parent."""
    return f"{folder.name}/{number:06d}.png"


def track_labels(objects: ShownObjects, seconds: np.ndarray, views: Iterable[View]) -> list[dict[str, Any]]:
    """A record for every object of an edited drive, first the actors; `seconds` (n,) of frames.

    `source` is the track, or the asset, whose Gaussians it has (None: it has none of its own); `shown_by` says what
    shows it in any of `views` (see `ShownObjects.shown_by`); `size` is length, width, height in metres, `scale`
    included; `color_matrix` (3, 3) maps its RGB colours in [0, 1] (None: unchanged); `object_to_world` (n times (4, 4))
    is at the box centre, rounded to 1e-6, None in frames where the object is absent."""
    shown_by, labels = objects.shown_by(objects.seen_in_any(views)), []
    for i, item in enumerate((*objects.actors, *objects.others)):
        present, poses = item.present(seconds), item.poses(seconds).round(DECIMALS)
        own = i < len(objects.actors)
        labels.append(
            {
                "id": item.id,
                "category": item.category,
                "size": item.size.tolist(),
                "source": item.source if own else None,
                "shown_by": shown_by[item.id],
                "scale": item.scale,
                "color_matrix": None if item.color_matrix is None else item.color_matrix.round(DECIMALS).tolist(),
                "edited": item.edited,
                "editable": own,
                "object_to_world": [pose.tolist() if now else None for now, pose in zip(present, poses, strict=True)],
            }
        )
    return labels
