"""A trained drive: the model of a method, with its scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import torch

from drivesplat.drive.cameras import Matrix, PoseableCamera, require_pose
from drivesplat.drive.drive_view import DriveView
from drivesplat.drive.world_state import WorldState
from drivesplat.editing.actors import other_objects, recorded_and_edited, trained_actors
from drivesplat.editing.ego import MAX_LEAD, EgoEdit
from drivesplat.editing.sensor_path import recorded_ego
from drivesplat.editing.shown_objects import ShownObjects
from drivesplat.errors import RequestError
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model, read_checkpoint
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.scene.scene import REFINED, Frame, Scene, Track, read_scene
from drivesplat.scene.tracks import box_at, ever_moves
from drivesplat.scene.training_record import TrainingRecord, read_training_record
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.tracks import FOUND, TRACK_FOLDERS, Tracks
from drivesplat.trajectories.camera_path import recorded_frames, recorded_timestamps, smooth_poses
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.workflow.edits_file import edit_of

if TYPE_CHECKING:
    import pandas

COLUMNS = [
    "id", "class", "category", "length", "width", "height", "first", "last", "speed", "editable", "why_not",
]  # fmt: skip
"""Those of `TrainedDrive.actors`."""
OUTSIDE = ("refuse", "clamp")
"""What can happen to a time outside of the recording."""


def open_drive(folder: str | Path, device: str | DeviceSettings = "any") -> "TrainedDrive":
    """The drive whose model a method has trained, from the method's result folder.

    Args:
        folder: `results/{scene}/{method}`, with `checkpoint.npz`; scene and training record lie beside it.
        device: 'any' (the GPU where there is one), 'cuda' or 'cpu', or settings as under `device` in config.yaml.

    Raises RequestError where the folder has no checkpoint, ResultError for files of another version, and DeviceError
    where the device is missing or its memory is exhausted.

    >>> drive = open_drive("results/demo/street")
    >>> drive.render("CAM_FRONT", time=4.2).image.shape
    (225, 400, 3)
    """
    folder = Path(folder)
    if not (folder / "checkpoint.npz").is_file():
        raise RequestError(
            f"{folder} has no checkpoint.npz: name the folder of a method that has been trained, such as "
            "results/demo/street"
        )
    checkpoint = read_checkpoint(folder / "checkpoint.npz")
    scene, record = _recording(folder.parent, checkpoint)
    kinds = get_args(DeviceSettings.model_fields["kind"].annotation)
    if not isinstance(device, DeviceSettings) and device not in kinds:
        raise RequestError(f"there is no device {device!r}; there are: {', '.join(kinds)}")
    settings = device if isinstance(device, DeviceSettings) else DeviceSettings.model_validate(device)
    model, chosen = open_model(checkpoint, settings)
    return TrainedDrive(folder, scene, record, model, chosen)


@dataclass(frozen=True, eq=False, repr=False)
class TrainedDrive:
    """A drive that can be rendered at any time from any pose: see `open_drive`. Times are seconds since the first
    image, as in films and edits; world coordinates are metres, z up; `edit` is what `edited` has changed."""

    folder: Path
    scene: Scene
    record: TrainingRecord
    model: SplatModel
    device: torch.device
    edit: Edit | None = None

    def __repr__(self) -> str:
        return f"<TrainedDrive {self.folder}: {self.duration:.1f} s, cameras {', '.join(self.cameras) or 'none'}>"

    @cached_property
    def cameras(self) -> list[str]:
        """The names of the recorded cameras."""
        return list(dict.fromkeys(frame.camera for frame in self.scene.frames))

    @cached_property
    def duration(self) -> float:
        """The time of the last image in seconds; of the last sweep without images."""
        recordings = self.scene.frames or self.scene.sweeps
        return self.scene.seconds(max(recording.timestamp for recording in recordings))

    @property
    def where(self) -> str:
        """The scene and the method, for messages."""
        return f"scene {self.scene.name}, method {self.folder.name}"

    @cached_property
    def edited_actors(self) -> list[EditedActor]:
        """The objects of which the model has Gaussians, after the edit."""
        if self.edit is None:
            return trained_actors(self.model, self.scene, self.where)
        return recorded_and_edited(self.model, self.scene, self._reference, self.edit, self.where)[1]

    @cached_property
    def _static(self) -> ShownObjects:
        """The annotated objects that the model shows in its static part, if at all."""
        dynamic = {track.id for track in self.scene.tracks if track.object_class.is_dynamic}
        trained = trained_actors(self.model, self.scene, self.where)
        others = [item for item in other_objects(self.scene, trained) if item.id in dynamic]
        return ShownObjects.of_scene(self.scene, self.model, [], others)

    @property
    def actors(self) -> "pandas.DataFrame":
        """A table of the objects as recorded, by `id`: `class` and the dataset's `category`; `length`, `width` and
        `height` in metres; `first` and `last`, the seconds of their boxes; `speed`, the largest horizontal one in m/s;
        `editable`, whether the object has Gaussians of its own and can be moved and removed; and `why_not`."""
        from pandas import DataFrame  # here: it takes long to import

        editable = {actor.id for actor in trained_actors(self.model, self.scene, self.where)}
        rows = [_row(self.scene, track, editable) for track in self.scene.tracks if track.object_class.is_dynamic]
        table = DataFrame(rows, columns=COLUMNS).set_index("id")
        return table.sort_values(["editable", "first"], ascending=[False, True])

    def edited(self, edit: Edit | list[dict[str, Any]]) -> "TrainedDrive":
        """The drive after an edit: its steps as in an edits file (docs/editing.md).

        Raises ConfigError for invalid steps and those that do not fit the drive, RequestError for a drive that is
        edited already.

        >>> gone = open_drive("results/demo/street").edited([{"remove": {"track": "bf53"}}])
        """
        if self.edit is not None:
            raise RequestError("the drive is edited already: give all steps at once to the drive as recorded")
        checked = edit if isinstance(edit, Edit) else edit_of(edit, f"{self.where}, edit")
        changed = replace(self, edit=checked)
        _ = changed.edited_actors, changed._ego_edit  # an edit that does not fit is refused here
        return changed

    def camera(self, name: str, exposure: bool = False) -> PoseableCamera:
        """A recorded camera: its intrinsics at the size of its training images and its mount; with its learned
        `exposure`, if wanted. Raises RequestError for an unknown camera."""
        index, frame = self._first_image(name)
        width, height = self.record.image_size(index)
        K = self.record.Ks[index].astype(np.float64)
        return PoseableCamera(width, height, K, frame.camera_to_ego, name if exposure else None)

    def ego_to_world(self, time: float) -> np.ndarray:
        """The pose (4, 4) of the ego vehicle; its origin is on the ground below the rear axle. Raises RequestError for
        a time outside of the recording, and where an edited vehicle has left the recorded path."""
        if self._ego_edit is not None:
            return self._edited_poses(self._reference, time)[1]
        at = np.array([self._checked(time)])
        return recorded_ego(self.scene, self.cameras[0] if self.cameras else None)(at)[0]

    def camera_to_world(self, name: str, time: float) -> np.ndarray:
        """The pose (4, 4) of a recorded camera: on the smooth path through its images, which films take, too. Raises
        RequestError as `ego_to_world`, and for a time at which this camera did not record."""
        self._first_image(name)
        if self._ego_edit is not None:
            return self._edited_poses(name, time)[0]
        frames = recorded_frames(self.scene, name)
        stamps = recorded_timestamps(self.scene, name)
        recorded = self.scene.seconds(stamps[0]) + (stamps - stamps[0]) * 1e-6
        if not recorded[0] - MAX_LEAD <= self._checked(time) <= recorded[-1] + MAX_LEAD:
            raise RequestError(
                f"camera {name} recorded from {recorded[0]:.2f} to {recorded[-1]:.2f} s, not at {time:g} s"
            )
        poses = np.stack([frame.camera_to_world for frame in frames])
        return smooth_poses(recorded * 1e6, poses, np.array([time]) * 1e6)[0]

    def view(
        self,
        camera: str | PoseableCamera,
        time: float,
        ego_to_world: Matrix | None = None,
        camera_to_world: Matrix | None = None,
    ) -> View:
        """A camera at a time and a pose, as the model renders it; see `WorldState.render`."""
        known = self.camera(camera) if isinstance(camera, str) else camera
        if camera_to_world is not None:
            if ego_to_world is not None:
                raise RequestError("a camera has one pose: give ego_to_world or camera_to_world, not both")
            pose = require_pose(camera_to_world, "the camera")
        elif isinstance(camera, str) and ego_to_world is None:
            pose = self.camera_to_world(camera, time)
        elif known.camera_to_ego is None:
            raise RequestError("a camera of one's own without camera_to_ego needs camera_to_world")
        else:
            ego = self.ego_to_world(time) if ego_to_world is None else require_pose(ego_to_world, "the ego vehicle")
            pose = ego @ known.camera_to_ego
        return known.view(pose, time, self.device)

    def state(self, time: float, outside: str = "refuse") -> WorldState:
        """The drive at a time. One outside of the recording is refused by a RequestError, or clamped to it."""
        if outside not in OUTSIDE:
            raise RequestError(f"outside is {outside!r}; it is one of {', '.join(OUTSIDE)}")
        now = min(max(time, 0.0), self.duration) if outside == "clamp" and np.isfinite(time) else self._checked(time)
        return WorldState(self.model, self.edited_actors, self._static, self.view, float(now), self.edit is None)

    def render(
        self,
        camera: str | PoseableCamera,
        time: float,
        *,
        ego_to_world: Matrix | None = None,
        camera_to_world: Matrix | None = None,
        outputs: Sequence[str] = ("rgb",),
        outside: str = "refuse",
    ) -> DriveView:
        """What a camera sees at a time: `state(time, outside).render(...)`."""
        state = self.state(time, outside)
        return state.render(camera, ego_to_world=ego_to_world, camera_to_world=camera_to_world, outputs=outputs)

    @property
    def _reference(self) -> str:
        """The camera whose images edits count from."""
        if not self.cameras:
            raise RequestError(f"{self.where} has no camera, and edits need one")
        return self.cameras[0]

    def _first_image(self, name: str) -> tuple[int, Frame]:
        for index, frame in enumerate(self.scene.frames):
            if frame.camera == name:
                return index, frame
        raise RequestError(f"{self.where} has no camera {name!r}; there are: {', '.join(self.cameras) or 'none'}")

    def _checked(self, time: float) -> float:
        """A time within the recording."""
        if not 0.0 <= time <= self.duration:
            raise RequestError(
                f"{self.where} was recorded from 0 to {self.duration:.2f} s, not at {time:g} s; outside='clamp' "
                "renders its start or its end"
            )
        return time

    @cached_property
    def _ego_edit(self) -> EgoEdit | None:
        """What the edit does to the ego vehicle."""
        return None if self.edit is None else EgoEdit.of(self.scene, self._reference, self.edit, self.where)

    def _edited_poses(self, camera: str, time: float) -> tuple[np.ndarray, np.ndarray]:
        """The poses of a camera and of the ego vehicle after the edit."""
        frames, at, change = recorded_frames(self.scene, camera), np.array([self._checked(time)]), self._ego_edit
        assert change is not None
        if not change.within(frames, at)[0]:
            raise RequestError(f"{self.where}: at {time:g} s the edited vehicle has left the recorded path")
        camera_to_world, ego_to_world = change.poses(frames, at)
        return camera_to_world[0], ego_to_world[0]


def _recording(folder: Path, checkpoint: TrainedCheckpoint) -> tuple[Scene, TrainingRecord]:
    """The scene with the tracks of a model, and the training record, from the result folder of a scene."""
    tracks = [track.id for part in checkpoint.parts for track in part.tracks]
    refined = "refine_poses" in checkpoint.provenance["stages"]
    own: Tracks = "discovered" if any(track.startswith(FOUND) for track in tracks) else "annotated"
    scene = folder / (REFINED if refined and own == "annotated" else Path(TRACK_FOLDERS[own], "scene.json"))
    parsers = [folder / TRACK_FOLDERS[of] / "parser.npz" for of in (own, "none")]  # the images of both are the same
    parser = next((path for path in parsers if path.is_file()), parsers[0])
    return read_scene(scene), read_training_record(parser)


def _row(scene: Scene, track: Track, editable: set[str]) -> list[Any]:
    boxes = (box_at(track, int(timestamp), 0.0) for timestamp in track.timestamps)
    speed = max((box.speed for box in boxes if box is not None), default=0.0)
    first, last = (scene.seconds(track.timestamps[i]) for i in (0, -1))
    own = track.id in editable
    why_not = "" if own else "no Gaussians of its own in this method" if ever_moves(track) else "parked"
    size = [round(float(edge), 3) for edge in track.size]
    return [track.id, track.object_class.value, track.category, *size, first, last, round(speed, 2), own, why_not]
