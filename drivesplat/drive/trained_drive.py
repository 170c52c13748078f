"""A trained drive: the model of a method, with its scene."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, overload

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from drivesplat.drive.cameras import (
    AS_DRIVEN,
    GivenPose,
    Matrix,
    PlacedCamera,
    PoseableCamera,
    Vector,
    mounted_velocity,
)
from drivesplat.drive.drive_view import DriveScan, DriveView
from drivesplat.drive.lidars import PoseableLidar
from drivesplat.drive.packed_drive import unpack_drive
from drivesplat.drive.recorded_drive import RecordedDrive, object_table
from drivesplat.drive.world_state import AnyCamera, Sensors, WorldState
from drivesplat.editing.actors import EditedModel, edited_model, other_objects, trained_actors
from drivesplat.editing.assets.library import read_inserts
from drivesplat.editing.ego import EgoEdit
from drivesplat.editing.sensor_path import EgoPoses
from drivesplat.editing.shown_objects import ShownObjects
from drivesplat.errors import RequestError
from drivesplat.io.storage import Provenance
from drivesplat.lidar.moved_sensor import moved, steady_motion
from drivesplat.lidar.scans import SensorPoses
from drivesplat.model.checkpoint import model_file, open_model, read_checkpoint, read_snapshot
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement
from drivesplat.model.view import View
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.scene import Scene
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.blocks import BLOCKS, block_scene_name
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.trajectories.camera_path import recorded_frames
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.workflow.edits_file import edit_of

if TYPE_CHECKING:
    import pandas

OUTSIDE = ("refuse", "clamp")
"""What can happen to a time outside of the recording."""
HALF_SPAN = 0.05
"""Half the time in seconds between the two poses that give the velocity of the ego vehicle."""


def open_drive(folder: str | Path, device: str | DeviceSettings = "any") -> "TrainedDrive":
    """The drive whose model a method has trained, from the method's result folder. While the training runs, the model
    is that of its last saved state.

    Args:
        folder: `results/{scene}/{method}`; scene and training record lie beside it. Or `scene.alpasim.usdz`, which
            holds all of it, and is unpacked once (`drivesplat.drive.packed_drive.unpack_drive`).
        device: 'any' (the GPU where there is one), 'cuda' or 'cpu', or settings as under `device` in config.yaml.

    Raises RequestError where the folder has no checkpoint, ResultError for damaged files and those of another version,
    and DeviceError where the device is missing or its memory is exhausted.

    >>> drive = open_drive("results/demo/street")
    >>> drive.render("CAM_FRONT", time=4.2).image.shape
    (225, 400, 3)
    """
    folder = Path(folder)
    folder = unpack_drive(folder) if folder.is_file() or folder.suffix == ".usdz" else folder
    if (folder.parent / BLOCKS).is_file():
        one = block_scene_name(folder.parent.name, 0)
        raise RequestError(f"{folder.parent} is cut into blocks: use drivesplat.LongDrive, or open one, such as {one}")
    file = model_file(folder)
    checkpoint = read_checkpoint(file) if file.parent == folder else read_snapshot(file.parent)
    tracks = [track.id for part in checkpoint.parts for track in part.tracks]
    recording = RecordedDrive.of_method(folder, tracks, "refine_poses" in checkpoint.provenance["stages"])
    kinds = get_args(DeviceSettings.model_fields["kind"].annotation)
    if not isinstance(device, DeviceSettings) and device not in kinds:
        raise RequestError(f"there is no device {device!r}; there are: {', '.join(kinds)}")
    settings = device if isinstance(device, DeviceSettings) else DeviceSettings.model_validate(device)
    model, chosen = open_model(checkpoint, settings)
    spread = checkpoint.job.train.scans.beam_spread_rad
    return TrainedDrive(folder, recording, model, chosen, spread, checkpoint.provenance)


@dataclass(frozen=True, eq=False, repr=False)
class TrainedDrive(Sensors):
    """A drive that can be rendered at any time from any pose: see `open_drive`. Times are seconds since the first
    image, as in films and edits; world coordinates are metres, z up; `edit` is what `edited` has changed."""

    folder: Path
    recording: RecordedDrive
    model: SplatModel
    device: torch.device
    beam_spread: tuple[float, float]
    provenance: Provenance
    """That of the checkpoint."""
    edit: Edit | None = None
    before: "TrainedDrive | None" = None
    """The drive as recorded, of an edited one."""

    def __repr__(self) -> str:
        sensors = ", ".join((*self.cameras, *self.lidars)) or "none"
        return f"<TrainedDrive {self.folder}: {self.duration:.1f} s, sensors {sensors}>"

    @property
    def scene(self) -> Scene:
        """The record of the scene, with the tracks of the model."""
        return self.recording.scene

    @property
    def record(self) -> TrainingRecord:
        """The record of the training images."""
        return self.recording.record

    @property
    def cameras(self) -> list[str]:
        """The names of the recorded cameras."""
        return list(self.recording.cameras)

    @property
    def lidars(self) -> list[str]:
        """The names of the recorded LiDARs."""
        return list(self.recording.lidars)

    @property
    def renders_lidar(self) -> bool:
        """Whether the method was trained with LiDAR, and the drive has one."""
        return bool(self.lidars) and all("lidar_logits" in part.params for part in self.model.parts)

    @property
    def duration(self) -> float:
        """The time of the last image in seconds; of the last sweep without images."""
        return self.recording.duration

    @property
    def where(self) -> str:
        """The scene and the method, for messages."""
        return self.recording.where

    @cached_property
    def edited_actors(self) -> list[EditedActor]:
        """The objects of which the model has Gaussians, after the edit."""
        return self._recorded_actors if self._edited is None else self._edited.actors

    @cached_property
    def _edited(self) -> EditedModel | None:
        """The model after the edit; None where it leaves the objects as recorded."""
        if self.edit is None or all(step.kind == "ego" for step in self.edit.steps):
            return None
        inserts = read_inserts(self.edit, self.folder)
        return edited_model(self.model, self.scene, self._reference, self.edit, self.where, inserts)

    @cached_property
    def _fixed(self) -> FixedModel:
        """The model after the edit, to render from."""
        if self._edited is not None and self._edited.model is not self.model:
            return FixedModel(self._edited.model)
        return FixedModel(self.model) if self.before is None else self.before._fixed

    @cached_property
    def _recorded_actors(self) -> list[EditedActor]:
        """The objects of which the model has Gaussians, as recorded."""
        if self.before is not None:
            return self.before._recorded_actors
        return trained_actors(self.model, self.scene, self.where)

    @cached_property
    def static_objects(self) -> ShownObjects:
        """The annotated objects that the model shows in its static part, if at all. No edit changes them."""
        if self.before is not None:
            return self.before.static_objects
        dynamic = {track.id for track in self.scene.tracks if track.object_class.is_dynamic}
        others = [item for item in other_objects(self.scene, self._recorded_actors) if item.id in dynamic]
        return ShownObjects.of_scene(self.scene, self.model, [], others)

    @property
    def actors(self) -> "pandas.DataFrame":
        """A table of the objects as recorded, by `id`: `class` and the dataset's `category`; `length`, `width` and
        `height` in metres; `first` and `last`, the seconds of their boxes; `speed`, the largest horizontal one in m/s;
        `editable`, whether the object has Gaussians of its own and can be moved and removed; and `why_not`."""
        return self._object_table.copy()

    @cached_property
    def _object_table(self) -> "pandas.DataFrame":
        return object_table(self.scene, {actor.id for actor in self._recorded_actors})

    def edited(self, edit: Edit | list[dict[str, Any]]) -> "TrainedDrive":
        """The drive after an edit: its steps as in an edits file (docs/editing.md).

        Raises ConfigError for invalid steps and those that do not fit the drive, RequestError for a drive that is
        edited already.

        >>> gone = open_drive("results/demo/street").edited([{"remove": {"track": "bf53"}}])
        """
        if self.edit is not None:
            raise RequestError("the drive is edited already: give all steps at once to the drive as recorded")
        checked = edit if isinstance(edit, Edit) else edit_of(edit, f"{self.where}, edit")
        changed = replace(self, edit=checked, before=self)
        _ = changed.edited_actors, changed._ego_edit  # an edit that does not fit is refused here
        return changed

    def camera(self, name: str, exposure: bool = False, rolling_shutter: bool = False) -> PoseableCamera:
        """A recorded camera: its intrinsics at the size of its training images and its mount; with its learned
        `exposure` and the readout of its `rolling_shutter`, if wanted and known. Raises RequestError for an unknown
        camera."""
        return self.recording.camera(name, exposure, rolling_shutter)

    def lidar(self, name: str, time: float = 0.0) -> PoseableLidar:
        """A recorded LiDAR: the rays of its scan that is nearest in time, and its mount. Raises RequestError for an
        unknown LiDAR, and where no scans were prepared."""
        return self.recording.lidar(name, time)

    def ego_to_world(self, time: float) -> np.ndarray:
        """The pose (4, 4) of the ego vehicle; its origin is on the ground below the rear axle. Raises RequestError for
        a time outside of the recording, and where an edited vehicle has left the recorded path."""
        if self._ego_edit is not None:
            return self._edited_poses(self._reference, time)[1]
        return self.recording.ego_to_world(time)

    def ego_velocity(self, time: float) -> np.ndarray:
        """The velocity (6,) of the ego vehicle along its own axes: linear (m/s), then angular (rad/s). Raises
        RequestError for a time outside of the recording."""
        _ = self.ego_to_world(time)  # refuses where there is none
        ends = np.clip(time + np.array([-HALF_SPAN, HALF_SPAN]), 0.0, self.duration)
        now, first, last = self.ego_path(np.array([time, *ends]))
        if not ends[1] > ends[0]:
            return np.zeros(6)
        turn = Rotation.from_matrix(first[:3, :3].T @ last[:3, :3]).as_rotvec()  # about axes of the first pose
        turn = now[:3, :3].T @ first[:3, :3] @ turn
        return np.concatenate([now[:3, :3].T @ (last - first)[:3, 3], turn]) / (ends[1] - ends[0])

    def camera_to_world(self, name: str, time: float) -> np.ndarray:
        """The pose (4, 4) of a recorded camera: on the smooth path through its images, which films take, too. Raises
        RequestError as `ego_to_world`, and for a time at which this camera did not record."""
        self.recording.first_image(name)
        if self._ego_edit is not None:
            return self._edited_poses(name, time)[0]
        return self.recording.camera_to_world(name, time)

    def placed_camera(self, camera: AnyCamera, time: float, at: GivenPose = AS_DRIVEN) -> PlacedCamera:
        """A camera at a time; see `WorldState.render`."""
        known = self.recording.camera_of_name(camera) if isinstance(camera, str) else camera
        if not isinstance(known, PoseableCamera):
            raise RequestError(f"a camera is a name or a drivesplat.Camera, not {camera!r}")
        if at.sensor_to_world is not None:
            return PlacedCamera(known, at.sensor_to_world, at.motion, time)
        mount, moving = known.camera_to_ego, at.motion
        if mount is None:
            raise RequestError("a camera of one's own without camera_to_ego needs camera_to_world")
        if at.ego_to_world is not None:
            pose = at.ego_to_world @ mount
        else:
            path = known.path_of
            pose = self.ego_to_world(time) @ mount if path is None else self.camera_to_world(path, time)
            if at.velocity is None and known.readout_s.any():
                moving = self.ego_velocity(time)
        return PlacedCamera(known, pose, mounted_velocity(moving, mount), time)

    def view(
        self,
        camera: AnyCamera,
        time: float,
        ego_to_world: Matrix | None = None,
        camera_to_world: Matrix | None = None,
        velocity: Vector | None = None,
    ) -> View:
        """A camera at a time and a pose as `SplatModel.render` takes it; see `WorldState.render`."""
        at = GivenPose.checked("the camera", ego_to_world, camera_to_world, velocity)
        return self.placed_camera(camera, time, at).view(self.device)

    def placed_lidar(
        self, lidar: str | PoseableLidar, time: float, at: GivenPose = AS_DRIVEN
    ) -> tuple[RecordedScan, tuple[float, float]]:
        """The rays of a LiDAR at a time, and the spread of its beams; see `WorldState.scan`."""
        recorded = self.recording.nearest_scan(lidar, time) if isinstance(lidar, str) else None
        known = self.lidar(lidar, time) if isinstance(lidar, str) else lidar
        path = self._lidar_path(known.sensor_to_ego, recorded, time, at)
        sensor = known.placed(path, time) if recorded is None else replace(moved(recorded, path), seconds=time)
        return sensor, known.beam_spread or self.beam_spread

    def _lidar_path(
        self, mount: np.ndarray | None, recorded: RecordedScan | None, time: float, at: GivenPose
    ) -> SensorPoses:
        """The poses of a LiDAR in the world at offsets in seconds from a time; `recorded` is the scan whose rays it
        fires."""
        linear, angular = at.motion.reshape(2, 3)
        if at.sensor_to_world is not None:
            return steady_motion(at.sensor_to_world, linear, angular)
        if mount is None:
            raise RequestError("a LiDAR of one's own without sensor_to_ego needs sensor_to_world")
        ego = self.ego_to_world(time) if at.ego_to_world is None else at.ego_to_world
        if at.ego_to_world is not None or at.velocity is not None:
            of_ego = steady_motion(ego, linear, angular)
            return lambda offsets: of_ego(offsets) @ mount
        if recorded is not None:
            return self.recording.carried(recorded, self.ego_path, time)
        return lambda offsets: self.ego_path(time + offsets) @ mount

    def state(
        self, time: float, outside: str = "refuse", placements: Mapping[str, ActorPlacement] | None = None
    ) -> WorldState:
        """The drive at a time. One outside of the recording is refused by a RequestError, or clamped to it. With
        `placements`, the objects of these ids, of `edited_actors`, are at these places, and no others are there."""
        if outside not in OUTSIDE:
            raise RequestError(f"outside is {outside!r}; it is one of {', '.join(OUTSIDE)}")
        if not isinstance(time, float | int | np.floating | np.integer):
            raise RequestError(f"a time is a number of seconds, not {time!r}")
        if outside == "refuse" and not 0.0 <= time <= self.duration:
            raise RequestError(f"{self.recording.outside(time)}; outside='clamp' renders its start or its end")
        inside = min(max(time, 0.0), self.duration) if outside == "clamp" and np.isfinite(time) else time
        now = float(self.recording.checked(inside))
        as_recorded = self.edit is None and placements is None
        return WorldState(self._fixed, self.edited_actors, self.static_objects, self, now, as_recorded, placements)

    @overload
    def render(
        self,
        camera: AnyCamera,
        time: float,
        *,
        ego_to_world: Matrix | None = None,
        camera_to_world: Matrix | None = None,
        velocity: Vector | None = None,
        outputs: Sequence[str] = ("rgb",),
        outside: str = "refuse",
    ) -> DriveView: ...

    @overload
    def render(
        self,
        camera: Sequence[AnyCamera],
        time: float,
        *,
        ego_to_world: Matrix | None = None,
        velocity: Vector | None = None,
        outputs: Sequence[str] = ("rgb",),
        outside: str = "refuse",
    ) -> list[DriveView]: ...

    def render(self, camera: Any, time: float, *, outside: str = "refuse", **at: Any) -> DriveView | list[DriveView]:
        """What a camera sees at a time, or each of several cameras: `state(time, outside).render(camera, ...)`, whose
        arguments it has."""
        return self.state(time, outside).render(camera, **at)

    def scan(
        self,
        lidar: str | PoseableLidar,
        time: float,
        *,
        ego_to_world: Matrix | None = None,
        sensor_to_world: Matrix | None = None,
        velocity: Vector | None = None,
        with_instance: bool = True,
        outside: str = "refuse",
    ) -> DriveScan:
        """What a LiDAR measures about a time: `state(time, outside).scan(...)`."""
        placed = {"ego_to_world": ego_to_world, "sensor_to_world": sensor_to_world, "velocity": velocity}
        return self.state(time, outside).scan(lidar, **placed, with_instance=with_instance)

    @property
    def _reference(self) -> str:
        """The camera whose images edits count from."""
        if not self.cameras:
            raise RequestError(f"{self.where} has no camera, and edits need one")
        return self.cameras[0]

    @cached_property
    def _ego_edit(self) -> EgoEdit | None:
        """What the edit does to the ego vehicle."""
        return None if self.edit is None else EgoEdit.of(self.scene, self._reference, self.edit, self.where)

    @cached_property
    def ego_path(self) -> EgoPoses:
        """The poses (n, 4, 4) of the ego vehicle after the edit, at seconds (n,) of the recording."""
        change = self._ego_edit
        if change is None:
            return self.recording.ego
        frames = recorded_frames(self.scene, self._reference)
        return lambda times: change.poses(frames, times)[1]

    def _edited_poses(self, camera: str, time: float) -> tuple[np.ndarray, np.ndarray]:
        """The poses of a camera and of the ego vehicle after the edit."""
        frames, change = recorded_frames(self.scene, camera), self._ego_edit
        at = np.array([self.recording.checked(time)])
        assert change is not None
        if not change.within(frames, at)[0]:
            raise RequestError(f"{self.where}: at {time:g} s the edited vehicle has left the recorded path")
        camera_to_world, ego_to_world = change.poses(frames, at)
        return camera_to_world[0], ego_to_world[0]
