"""The record of one drive that all stages share, independent of the dataset.

Frames of reference. World: metres, z up, axes of the dataset's global frame, origin at the first ego
position (`Scene.origin`, kept in float64). Camera: OpenCV (x right, y down, z forward). Intrinsics: OpenCV (integer
coordinates at pixel centres), in pixels of the recorded image. Object: x forward, y left, z up, at the box centre.
Ego: x forward, y left, z up, on the ground under the rear axle. Timestamps: microseconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from drivesplat.errors import DatasetError
from drivesplat.io.json_record import read_typed_json, write_typed_json
from drivesplat.io.storage import Provenance, no_provenance
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import inverse
from drivesplat.scene.sensors import Camera, Lidar, SweepMotion
from drivesplat.settings.tracks import OTHER_TRACKS

SCHEMA = 1
UNPOSED = "none"
"""`Scene.poses` of a drive without any: those of the ego vehicle are the identity."""
REFINED = "scene_refined.json"
"""File name of the record with refined poses."""


@dataclass(frozen=True)
class Frame:
    """One image. `camera` is a name in `Scene.cameras`; `camera_to_world` and `ego_to_world` hold at the image's own
    timestamp; `readout_middle_s` is the time in seconds from there to the middle of a rolling shutter's readout.
    `camera_velocity` (6,) is `Shutter.velocity` where the dataset has the camera's motion during the readout; None: it
    follows from the images before and after.
    `classes_path` is the dataset's own class map of the image (8 bits, 255: unlabelled), if it has one."""

    camera: str
    timestamp: int
    image_path: str
    width: int
    height: int
    intrinsics: Float64[np.ndarray, "3 3"]
    camera_to_world: Float64[np.ndarray, "4 4"]
    ego_to_world: Float64[np.ndarray, "4 4"]
    is_key_frame: bool
    sample_index: int
    token: str
    classes_path: str | None = None
    readout_middle_s: float = 0.0
    camera_velocity: Float64[np.ndarray, "6"] | None = None

    @property
    def camera_to_ego(self) -> np.ndarray:
        """The mount of the camera (4, 4), by the poses of this image."""
        return inverse(self.ego_to_world) @ self.camera_to_world


@dataclass(frozen=True)
class Sweep:
    """One LiDAR revolution. `sensor_to_world` holds at the sweep's timestamp; `path` may be missing on disk. `lidar` is
    a name in `Scene.lidars`; `reader` names the package of `drivesplat.readers` that reads it; `motion` is that of the
    LiDAR where the file's points are not motion-compensated: reading them compensates it."""

    path: str
    timestamp: int
    sensor_to_world: Float64[np.ndarray, "4 4"]
    is_key_frame: bool
    sample_index: int
    token: str
    lidar: str
    reader: str
    motion: SweepMotion | None = None


@dataclass(frozen=True)
class Track:
    """One annotated object over time. `category` is the dataset's own name of its class.

    `size` is length, width, height in metres. There are n annotations, at increasing `timestamps` and `sample_indices`;
    `visibility` is 1 (0-40 %) to 4 (80-100 %), 0 if unknown.
    """

    id: str
    object_class: ObjectClass
    category: str
    size: Float64[np.ndarray, "3"]
    timestamps: Int64[np.ndarray, " n"]
    sample_indices: Int64[np.ndarray, " n"]
    object_to_world: Float64[np.ndarray, "n 4 4"]
    visibility: Int64[np.ndarray, " n"]


@dataclass(frozen=True)
class Scene:
    """A recorded drive.

    Key frame i of `key_frame_timestamps` is `sample_index` i. `origin`: global = world + origin. `poses` names
    where the poses come from (a reader, 'refined', 'images', UNPOSED); `key_frame_hz` is the nominal rate of key
    frames; `key_frame_range` the dataset's key frames [first, last + 1) that were read, None for all. `cameras` and
    `lidars` are the sensors that frames and sweeps name; `licence` says who may use the recording, where it is known;
    `sky_class` is the sky in class maps of the dataset; `held_out` are the key frames of each group that is not
    trained on (`drivesplat.scene.splits.Group`), of a block of a longer drive; None: the settings say.
    """

    name: str
    dataset: str
    version: str
    description: str
    origin: Float64[np.ndarray, "3"]
    key_frame_timestamps: Int64[np.ndarray, " n"]
    frames: tuple[Frame, ...]
    sweeps: tuple[Sweep, ...]
    tracks: tuple[Track, ...]
    poses: str
    key_frame_hz: float
    key_frame_range: list[int] | None = None
    missing_images: int = 0
    cameras: tuple[Camera, ...] = ()
    lidars: tuple[Lidar, ...] = ()
    provenance: Provenance = field(default_factory=no_provenance)
    licence: str = ""
    sky_class: int | None = None
    held_out: dict[str, list[int]] | None = None

    @property
    def key_frame_interval(self) -> float:
        """The median time between key frames, in microseconds."""
        if len(self.key_frame_timestamps) < 2:
            return 1e6 / self.key_frame_hz
        return float(np.median(np.diff(self.key_frame_timestamps)))

    def seconds(self, timestamp: int | np.integer) -> float:
        """A timestamp (microseconds) as seconds since the first image (the first sweep, without images), the time unit
        of models."""
        return float(timestamp - self._start) * 1e-6

    @cached_property
    def _start(self) -> int:
        """The timestamp of the first image, or else of the first sweep."""
        return min(recording.timestamp for recording in self.frames or self.sweeps)

    def track(self, track_id: str) -> Track | None:
        """The track with this id; None if there is none."""
        return next((track for track in self.tracks if track.id == track_id), None)

    def front_camera(self, cameras: Sequence[str]) -> str | None:
        """Which of `cameras` looks ahead the most, the first of equal ones; None without any."""
        ahead = {frame.camera: round(float(frame.camera_to_ego[0, 2]), 1) for frame in self.frames}
        return max(cameras, key=ahead.__getitem__, default=None)

    def key_frames(self, camera: str) -> list[int]:
        """The indices in `frames` of the key frames of `camera`."""
        return [i for i, frame in enumerate(self.frames) if frame.camera == camera and frame.is_key_frame]

    def middle_key_frame(self, camera: str) -> int:
        """The index in `frames` of the key frame of `camera` in the middle of the drive.

        Raises DatasetError that names the cameras with key frames if this one has none.
        """
        found = self.key_frames(camera)
        if not found:
            known = ", ".join(dict.fromkeys(frame.camera for frame in self.frames if frame.is_key_frame))
            raise DatasetError(
                f"scene {self.name}: eval_camera {camera} has no key frame; choose one of {known or 'none'}"
            )
        return sorted(found, key=lambda i: self.frames[i].timestamp)[len(found) // 2]

    def nearest_key_frame(self, timestamp: int) -> int:
        """The index of the key frame nearest to `timestamp` (microseconds)."""
        return int(np.argmin(np.abs(self.key_frame_timestamps - timestamp)))


def place_of(recording: Frame | Sweep) -> str:
    """The key frame (or the nearest one) and the token of a frame or sweep, for messages."""
    where = "" if recording.is_key_frame else "between key frames, nearest "
    return f"{where}key frame {recording.sample_index}, token {recording.token}"


def write_scene(path: str | Path, scene: Scene) -> None:
    write_typed_json(path, scene, SCHEMA)


def read_scene(path: str | Path) -> Scene:
    """Reads scene.json. Raises ResultError that names the file and its rule if it is not a scene record.

    >>> scene = read_scene("results/0001/scene.json")
    >>> frame = scene.frames[0]
    >>> frame.camera, frame.camera_to_world.shape, scene.seconds(frame.timestamp)
    ('CAM_FRONT', (4, 4), 0.0)
    >>> [track.object_class.value for track in scene.tracks]
    ['car', 'truck', 'pedestrian', 'other_movable']
    """
    rule = "refine_poses" if Path(path).name == REFINED else "extract"
    if Path(path).parent.name in OTHER_TRACKS:
        rule = "relabel"
    return read_typed_json(path, rule, Scene, SCHEMA, "a scene record")
