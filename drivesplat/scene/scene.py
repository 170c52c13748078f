"""The record of one drive that all stages share, independent of the dataset.

Frames of reference. World: metres, z up, axes of the dataset's global frame, origin at the first ego
position (`Scene.origin`, kept in float64). Camera: OpenCV (x right, y down, z forward). Intrinsics: OpenCV (integer
coordinates at pixel centres), in pixels of the recorded image. Object: x forward, y left, z up, at the box centre.
Ego: x forward, y left, z up, on the ground under the rear axle. Timestamps: microseconds.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.io.storage import Provenance, read_json, unreadable, write_json
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.sensors import Camera, Lidar

SCHEMA = 1
REFINED = "scene_refined.json"
"""File name of the record with refined poses."""


@dataclass(frozen=True)
class Frame:
    """One image. `camera` is a name in `Scene.cameras`; `intrinsics` (3, 3); `camera_to_world`, `ego_to_world` (4, 4)
    at the image's own timestamp."""

    camera: str
    timestamp: int
    image_path: str
    width: int
    height: int
    intrinsics: np.ndarray
    camera_to_world: np.ndarray
    ego_to_world: np.ndarray
    is_key_frame: bool
    sample_index: int
    token: str


@dataclass(frozen=True)
class Sweep:
    """One LiDAR revolution. `sensor_to_world` (4, 4) at the sweep's timestamp; `path` may be missing on disk. `lidar`
    is a name in `Scene.lidars`; `reader` names the package of `drivesplat.readers` that reads it."""

    path: str
    timestamp: int
    sensor_to_world: np.ndarray
    is_key_frame: bool
    sample_index: int
    token: str
    lidar: str
    reader: str


@dataclass(frozen=True)
class Track:
    """One annotated object over time. `category` is the dataset's own name of its class.

    `size` (3,) is length, width, height in metres. Per annotation: `timestamps` (n,), `sample_indices` (n,),
    increasing; `object_to_world` (n, 4, 4); `visibility` (n,): 1 (0-40 %) to 4 (80-100 %), 0 if unknown.
    """

    id: str
    object_class: ObjectClass
    category: str
    size: np.ndarray
    timestamps: np.ndarray
    sample_indices: np.ndarray
    object_to_world: np.ndarray
    visibility: np.ndarray


@dataclass(frozen=True)
class Scene:
    """A recorded drive.

    `key_frame_timestamps` (n,): key frame i is `sample_index` i. `origin` (3,): global = world + origin. `poses` names
    where the poses come from (a reader, 'refined', 'images'); `key_frame_hz` is the nominal rate of key frames;
    `key_frame_range` the dataset's key frames [first, last + 1) that were read, None for all. `cameras` and `lidars`
    are the sensors that frames and sweeps name.
    """

    name: str
    dataset: str
    version: str
    description: str
    origin: np.ndarray
    key_frame_timestamps: np.ndarray
    frames: tuple[Frame, ...]
    sweeps: tuple[Sweep, ...]
    tracks: tuple[Track, ...]
    poses: str
    key_frame_hz: float
    key_frame_range: list[int] | None = None
    missing_images: int = 0
    cameras: tuple[Camera, ...] = ()
    lidars: tuple[Lidar, ...] = ()
    provenance: Provenance = field(default_factory=dict)

    @property
    def key_frame_interval(self) -> float:
        """The median time between key frames, in microseconds."""
        if len(self.key_frame_timestamps) < 2:
            return 1e6 / self.key_frame_hz
        return float(np.median(np.diff(self.key_frame_timestamps)))

    def seconds(self, timestamp: int | np.integer) -> float:
        """A timestamp (microseconds) as seconds since the first image, the time unit of models."""
        return float(timestamp - min(frame.timestamp for frame in self.frames)) * 1e-6

    def track(self, track_id: str) -> Track | None:
        """The track with this id; None if there is none."""
        return next((track for track in self.tracks if track.id == track_id), None)

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


_ARRAYS = {
    "intrinsics": np.float64,
    "camera_to_world": np.float64,
    "ego_to_world": np.float64,
    "sensor_to_world": np.float64,
    "object_to_world": np.float64,
    "origin": np.float64,
    "size": np.float64,
    "timestamps": np.int64,
    "sample_indices": np.int64,
    "visibility": np.int64,
    "key_frame_timestamps": np.int64,
    "distortion": np.float64,
    "beam_elevations": np.float64,
}
_RECORDS: dict[str, type] = {"frames": Frame, "sweeps": Sweep, "tracks": Track, "cameras": Camera, "lidars": Lidar}


def write_scene(path: str | Path, scene: Scene) -> None:
    """Writes `scene.json`."""
    write_json(path, {"schema": SCHEMA, **_to_plain(scene)})


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
    content = read_json(path, rule)
    try:
        if content.pop("schema") != SCHEMA:
            raise ValueError("it has another schema")
        return _from_plain(Scene, content)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(path, rule, f"not a scene record ({error})") from error


def _to_plain(record: Any) -> dict[str, Any]:
    plain = {}
    for name, value in vars(record).items():
        if isinstance(value, np.ndarray):
            plain[name] = value.tolist()
        elif name in _RECORDS:
            plain[name] = [_to_plain(item) for item in value]
        else:
            plain[name] = value
    return plain


def _from_plain(kind: type, plain: dict[str, Any]) -> Any:
    values = {}
    for name, value in plain.items():
        if name in _ARRAYS and value is not None:
            values[name] = np.array(value, dtype=_ARRAYS[name])
        elif name in _RECORDS:
            values[name] = tuple(_from_plain(_RECORDS[name], item) for item in value)
        elif name == "object_class":
            values[name] = ObjectClass(value)
        else:
            values[name] = value
    return kind(**values)
