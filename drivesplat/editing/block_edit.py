"""The stage `edit_blocks`: an edit of a long drive, of which each block shows its own objects.

The edit is made once, of the objects and in the time of the whole drive; each block then shows the objects that it has
learned where the edited drive has them. An object that an edit brings into a block that has not learned it is absent
there.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from drivesplat.editing.actors import trained_actors, warn_of_collisions
from drivesplat.editing.ego import EgoEdit, edited_camera_path
from drivesplat.editing.film import EditFiles, Still, edited_frames, warn_of_late_steps
from drivesplat.io.storage import Provenance
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.rendering.block_film import OpenBlocks, block_pictures, shot_in_block
from drivesplat.rendering.captions import drive_captions
from drivesplat.rendering.film import Shot, encode_film, shot_of
from drivesplat.rendering.panels import Panels
from drivesplat.scene.blocks import Blocks
from drivesplat.scene.images import write_png
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import RECORDED_IN_WORDS, BlockEditJob, TrajectorySettings
from drivesplat.trajectories.camera_path import CameraPath, film_path, recorded_frames
from drivesplat.trajectories.edited_actors import EditedActor, edited_actors
from drivesplat.trajectories.ego_path import recorded_time
from drivesplat.trajectories.motion import Motion

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ActorInBlock(EditedActor):
    """An actor of a drive whose `path` an edit has changed, in the time and the world of a block: these are `begins`
    seconds later and `origin` (3,) metres further than those of the drive. Its limbs have advanced by `walked_before`
    metres less."""

    begins: float = 0.0
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    walked_before: float = 0.0

    def present(self, times: np.ndarray) -> np.ndarray:
        return super().present(np.asarray(times) + self.begins)

    def poses(self, times: np.ndarray) -> np.ndarray:
        found = super().poses(np.asarray(times) + self.begins).copy()
        found[:, :3, 3] -= self.origin
        return found

    def walked(self, times: np.ndarray) -> np.ndarray:
        return super().walked(np.asarray(times) + self.begins) - self.walked_before


@dataclass(frozen=True)
class EditedDrive:
    """The objects of a drive as `recorded`, by id, and after an edit (`actors`), in the time and world of the drive's
    `scene`."""

    scene: Scene
    recorded: Mapping[str, EditedActor]
    actors: Sequence[EditedActor]

    @classmethod
    def of(cls, scene: Scene, job: BlockEditJob, where: str) -> "EditedDrive":
        """Raises ConfigError, starting with `where`, if the edit does not fit the drive, DatasetError if it lacks the
        camera."""
        recorded = [
            EditedActor.recorded(one.id, one.object_class, one.category, one.size, Motion.of_track(scene, one))
            for one in scene.tracks
        ]
        ego_to_world = np.stack([frame.ego_to_world for frame in recorded_frames(scene, job.camera)])
        actors = edited_actors(recorded, job.edit, where, (), ego_to_world)
        return cls(scene, {actor.id: actor for actor in recorded}, actors)

    @property
    def changed(self) -> set[str]:
        """The ids of the recorded objects that the edit changes, copies, or removes."""
        return {actor.source for actor in self.actors if actor.edited} | self.recorded.keys() - {
            a.id for a in self.actors
        }

    def in_block(self, own: Sequence[EditedActor], block: Scene) -> list[EditedActor]:
        """The actors of a block after the edit, in its time and world, from those that it has learned (`own`). Those
        that the edit leaves on their paths move as the block has learned it."""
        learned = {actor.id: actor for actor in own}
        begins = self.scene.seconds(min(frame.timestamp for frame in block.frames))
        found = []
        for actor in self.actors:
            mine = learned.get(actor.source)
            if mine is None:
                continue
            before = self.recorded[actor.source]
            if actor.path is before.path:
                found.append(replace(actor, path=mine.path) if actor.edited else mine)
                continue
            first = np.array([mine.path.begin])
            values = {one.name: getattr(actor, one.name) for one in fields(actor)}
            walked = float((before.walked(first + begins) - mine.walked(first))[0])
            origin = block.origin - self.scene.origin
            found.append(ActorInBlock(**values, begins=begins, origin=origin, walked_before=walked))
        return found


class _EditedBlocks:
    """The blocks of an edited drive, as `OpenBlocks` gives those of the recorded one; `shown` are the ids of the edited
    objects that each block has, by its number, and `learned` those of all objects that any block has learned."""

    def __init__(self, opened: OpenBlocks, drive: EditedDrive, where: str):
        self._opened, self._drive, self._where = opened, drive, where
        self.shown: dict[int, list[str]] = {}
        self.learned: set[str] = set()

    def frames(self, shot: Shot, number: int, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """Some frames of a shot, as a block shows them."""
        fixed, block, device = self._opened.block(number)
        own = trained_actors(fixed.model, block, self._where)
        actors = self._drive.in_block(own, block)
        self.learned |= {actor.id for actor in own}
        self.shown[number] = sorted(actor.id for actor in actors if actor.edited)
        within = shot_in_block(shot, slice(indices[0], indices[-1] + 1), block)
        return edited_frames(fixed.model, within.views(device), actors, np.array(within.seconds))


def render_block_edit(
    scene: Scene,
    blocks: Blocks,
    scenes: Sequence[str],
    checkpoints: Sequence[str],
    job: BlockEditJob,
    device_settings: DeviceSettings,
    files: EditFiles,
) -> tuple[dict[str, Any], list[Provenance]]:
    """Writes the film of an edited drive beside the recorded one, and a still of it, from the files of its blocks that
    are not left out, in order. Returns the content of the record without provenance: the cameras of the edited drive,
    the places of the panels in the `film`, and which `blocks` show the objects that the edit changes; and the
    provenances of the checkpoints.

    Raises ConfigError if the edit does not fit the drive; DatasetError, DeviceError and ResultError as `render_film`.
    """
    where = f"scene {scene.name}, edit {files.film.stem!r}"
    drive, (before, after) = EditedDrive.of(scene, job, where), _shots(scene, job, where)
    opened = OpenBlocks(blocks, job.left_out, scenes, checkpoints, device_settings)
    edited = _EditedBlocks(opened, drive, where)
    seconds = np.array(after.seconds)
    colliding = warn_of_collisions(drive.actors, after.cameras.camera_to_world, seconds, where)
    panels = Panels(("recorded", files.film.stem), after.size)
    still = Still(panels, avoided=colliding | (seconds > after.trained_until))
    pairs = still.pairs(
        block_pictures(before, blocks, opened.frames, job.left_out),
        block_pictures(after, blocks, edited.frames, job.left_out, _driven(after, job, where)),
    )
    captions = drive_captions([RECORDED_IN_WORDS, f"edited: {files.film.stem}"], after.seconds, after.trained_until)
    with explain_out_of_memory(lambda: len(opened)):
        figures = encode_film(files.film, zip(pairs, captions, strict=True), len(captions), panels, after.format)
    write_png(files.still, still.picture)
    for name in sorted(drive.changed - edited.learned):
        log.warning(
            "%s: no block has learned %s as an object of its own, so that the edit does not change it", where, name
        )
    names = blocks.names
    record = {
        **after.record(),
        "film": panels.record(),
        "edit": job.edit.model_dump(mode="json"),
        "still_frame": still.number,
        "blocks": {names[number]: shown for number, shown in sorted(edited.shown.items())},
        "left_out": [names[number] for number in job.left_out],
        **figures,
    }
    return record, opened.upstream


def _shots(scene: Scene, job: BlockEditJob, where: str) -> tuple[Shot, Shot]:
    """The recorded drive, and the edited one at the same times."""
    path = edited_camera_path(scene, job.camera, job.fps, job.edit, where)
    unedited = film_path(scene, job.camera, job.fps, TrajectorySettings())[: len(path)]
    before, after = (shot_of(scene, cameras, job) for cameras in (unedited, path))
    if len(after.cameras) < len(path):
        warn_of_late_steps(job.edit, after.seconds[-1], where)
    return before, after


def _driven(shot: Shot, job: BlockEditJob, where: str) -> CameraPath:
    """The cameras of an edited shot with the timestamps at which the vehicle was recorded at their places, which tell
    their blocks."""
    ego, seconds = EgoEdit.of(shot.scene, job.camera, job.edit, where), np.array(shot.seconds)
    if ego is None:
        return shot.cameras
    later = recorded_time(ego.steps, ego.begin, seconds) - seconds
    return CameraPath(shot.cameras.timestamps + np.round(later * 1e6).astype(np.int64), shot.cameras.camera_to_world)
