"""The content of drive.json. Metres, radians, microseconds.

Frames of reference. World: z up, any origin. Ego: x forward, y left, z up, on the ground under the rear axle. Camera:
OpenCV (x right, y down, z forward). LiDAR: the sensor's own. Object: x forward, y left, z up, at the centre of the box.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivesplat.errors import DatasetError
from drivesplat.io.regular_file import regular_file
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.sensors import Camera, DistortionModel, Lidar

FILE = "drive.json"
MAX_ALIKE = 3
"""Maximum number of faults that are reported one by one if they differ in numbers only."""
MICROSECONDS_FROM = 1e12
"""A timestamp from here on is in microseconds: as seconds it would be 30,000 years after 1970."""

Timestamp = Annotated[int, Field(ge=0, lt=2**62, strict=True)]
Vector = tuple[float, float, float]
Row = Vector
RelativePath = Annotated[str, Field(min_length=1, max_length=1000)]
"""The path of a file, relative to the folder of drive.json and inside it."""


class DriveRecord(BaseModel):
    """A record of drive.json: unknown keys are refused, and numbers are finite."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True, populate_by_name=True
    )


class Pose(DriveRecord):
    """A frame of reference in another one: maps points p of the first to rotation · p + translation."""

    translation: Vector
    """Metres."""
    rotation: tuple[float, float, float, float] | tuple[Row, Row, Row]
    """Unit quaternion w, x, y, z, or rotation matrix, row by row."""


class TimedPose(Pose):
    """A pose at a time."""

    timestamp: Timestamp
    """Microseconds, on one clock for all sensors."""


class Distortion(DriveRecord):
    """The distortion of a camera's images."""

    model: DistortionModel = "none"
    """'opencv': k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tauX, tauY]]]]; 'fisheye': the four of cv2.fisheye;
    'angle_to_radius': the radius in pixels by powers of the angle in radians, from the first power on;
    'radius_to_angle': the reverse; 'mei': xi, k1, k2, p1, p2."""
    coefficients: tuple[float, ...] = Field((), max_length=30)


class DriveCamera(DriveRecord):
    """A camera of the vehicle."""

    width: int = Field(ge=1, le=20_000)
    """Pixels."""
    height: int = Field(ge=1, le=20_000)
    """Pixels."""
    K: tuple[Row, Row, Row]
    """Pinhole matrix in pixels; the centre of the first pixel is (0, 0), as in OpenCV."""
    sensor_to_ego: Pose
    """The camera in the ego frame."""
    distortion: Distortion = Distortion()
    readout_s: float | None = Field(None, ge=0, le=1)
    """Time from the first line of pixels to the last (seconds). null: unknown."""
    readout_direction: Literal["down", "up", "left", "right"] | None = None
    """The direction in which lines are read out. null: unknown."""

    def sensor(self, name: str) -> Camera:
        """The camera as scenes have it."""
        distortion = np.array(self.distortion.coefficients or np.zeros(5))
        return Camera(
            name, self.width, self.height, np.array(self.K), distortion, self.readout_s, self.readout_direction,
            self.distortion.model,
        )  # fmt: skip


class DriveLidar(DriveRecord):
    """A spinning LiDAR of the vehicle."""

    sensor_to_ego: Pose
    """The LiDAR in the ego frame."""
    beam_elevations: tuple[float, ...] | None = None
    """Elevation of each beam above the sensor's horizontal plane (radians), in the order of rings. null: unknown."""
    azimuth_steps: int | None = Field(None, ge=1)
    """Firings of a beam per revolution. null: unknown."""
    revolution_s: float | None = Field(None, gt=0, le=10)
    """Time of a revolution (seconds). null: unknown."""
    motion_compensated: bool = True
    """Whether all points of a sweep are where they would have been seen at its timestamp. false: each is in the
    sensor's frame at its own `time`, and the reader moves it by ego_poses."""

    def sensor(self, name: str) -> Lidar:
        """The LiDAR as scenes have it."""
        return Lidar(name, None if self.beam_elevations is None else np.array(self.beam_elevations), self.azimuth_steps)


class DriveFrame(DriveRecord):
    """An image."""

    camera: str
    timestamp: Timestamp
    file: RelativePath
    key_frame: bool | None = None
    """Whether it belongs to a key frame. null: the image nearest to each key frame does."""
    camera_to_world: Pose | None = None
    """The camera's own pose. null: ego pose and sensor_to_ego."""
    ego_to_world: Pose | None = None
    """The ego vehicle's pose at the image's time. null: by ego_poses, or by camera_to_world where that is given."""
    camera_velocity: tuple[float, float, float, float, float, float] | None = None
    """The camera's linear (m/s), then angular velocity (rad/s) during the readout, along its own axes. null: by the
    images before and after."""
    readout_middle_s: float = Field(0.0, ge=-1, le=1)
    """Time from the timestamp to the middle of the readout (seconds), negative where the timestamp is later: half of
    the camera's readout_s if timestamps are those of the first line."""


class DriveSweep(DriveRecord):
    """A LiDAR sweep: .npz, .ply or .pcd (docs/own_data.md)."""

    lidar: str
    timestamp: Timestamp
    """The time to which the points are motion-compensated, or to which their `time` refers."""
    file: RelativePath
    lidar_to_world: Pose | None = None
    """The LiDAR's own pose. null: ego pose and sensor_to_ego."""


class TrackPose(TimedPose):
    """The box of an object at a time, in the world."""

    visibility: float | None = Field(None, ge=0, le=1)
    """Visible share of the object in the images. null: unknown."""


class DriveTrack(DriveRecord):
    """An annotated object over time."""

    id: str = Field(min_length=1, max_length=200)
    object_class: ObjectClass = Field(alias="class")
    category: str | None = None
    """Your own name of the class, for tables. null: that of the class."""
    size: Annotated[Vector, Field()]
    """Length, width, height (metres)."""
    poses: tuple[TrackPose, ...] = Field(min_length=1)


class Rendered(DriveRecord):
    """Marks a rendered drive: its source, and how it was made."""

    scene: str
    """The recorded scene."""
    method: str
    edit: str | None = None
    """The name of the edit; null: the drive is unedited."""
    trajectory: str | None = None
    """The name of the trajectory; null: the recorded one, or that of the edit or the run."""
    run: str | None = None
    """The name of the run in the closed loop; null: the ego vehicle drives as recorded or edited."""
    seed: int | None = None
    """The seed of the run."""
    steps: tuple[dict[str, Any], ...] | None = None
    """The steps of the edit."""
    trained_until: Timestamp | None = None
    """Time of the last training image of the evaluated camera: later images are extrapolated."""
    shown_by: dict[str, str] = {}
    """What shows each object, by its id: 'own', Gaussians of its own; the name of a part, such as 'background'; or
    'none': it moves and has no Gaussians of its own, or no image of a key frame shows it. It has no boxes then, except
    in a run, whose policy knows the boxes of all objects."""
    instances: dict[str, int] | None = None
    """The number of each object in the images of the folder `instances`. null: the drive has none."""
    provenance: dict[str, Any] = {}
    """Settings, code and inputs of all results behind the drive."""


class Drive(DriveRecord):
    """A drive folder's drive.json."""

    format: Literal["drivesplat drive"]
    version: Literal[1]
    description: str = ""
    licence: str = ""
    """Who may use the recording, and for what. Exports repeat it."""
    rendered: Rendered | None = None
    """How the images were rendered. null: they were recorded."""
    origin: Vector | None = None
    """Global coordinates of the world's origin: global = world + origin. null: all poses are global, and the reader
    takes the first ego position as origin, since single precision holds no global coordinates."""
    cameras: dict[str, DriveCamera] = {}
    lidars: dict[str, DriveLidar] = {}
    ego_poses: tuple[TimedPose, ...] = ()
    """The ego vehicle in the world, at any rate, in time order. Poses between two of them are interpolated."""
    key_frames: tuple[Timestamp, ...] | None = None
    """The times of key frames, in order: the times that are held out or trained on as one, and at which tracks are
    sampled. null: those of the first camera's key frames, or of all of its images; of the first LiDAR's sweeps where
    there are no images."""
    frames: tuple[DriveFrame, ...] = ()
    sweeps: tuple[DriveSweep, ...] = ()
    tracks: tuple[DriveTrack, ...] = ()


def read_drive(folder: Path) -> Drive:
    """The drive.json of a folder. Raises DatasetError, a line for each fault of its structure."""
    path = folder / FILE
    faults, drive = structure_of(path)
    if drive is None:
        raise DatasetError("\n".join(grouped(faults)))
    return drive


def grouped(faults: Iterable[str]) -> list[str]:
    """The first MAX_ALIKE of the faults that differ in numbers only, with how many more there are, in their order."""
    alike: dict[str, list[str]] = {}
    for fault in faults:
        alike.setdefault(re.sub(r"\d+", "#", fault), []).append(fault)
    lines: list[str] = []
    for same in alike.values():
        lines += same[:MAX_ALIKE]
        if len(same) > MAX_ALIKE:
            lines.append(f"… and {len(same) - MAX_ALIKE} more like this")
    return lines


def structure_of(path: Path) -> tuple[list[str], Drive | None]:
    """The faults of a drive.json's structure, a sentence each, and its content where there are none."""
    try:
        values = json.loads(regular_file(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return [f"{path} is missing; docs/own_data.md says what a drive folder holds"], None
    except (OSError, UnicodeDecodeError) as error:
        return [f"{path} cannot be read ({error})"], None
    except (ValueError, RecursionError) as error:
        return [f"{path} is not JSON ({type(error).__name__}: {str(error)[:200]})"], None
    try:
        return [], Drive.model_validate(values)
    except ValidationError as error:
        return [f"{path}: {sentence_of(item)}" for item in error.errors(include_url=False)], None


def sentence_of(item: Any) -> str:
    """One error of pydantic as a sentence: frames[3].timestamp is …"""
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in item["loc"]).removeprefix(".")
    if item["type"] == "missing":
        return f"{key} is missing"
    if item["type"] == "extra_forbidden":
        return f"{key} is no key of the format; check its spelling"
    value = repr(item["input"])
    shown = value if len(value) <= 80 else f"{value[:80]}…"
    if item["loc"][-1:] == ("timestamp",):
        if isinstance(item["input"], float) and abs(item["input"]) >= MICROSECONDS_FROM:
            return f"{key} is {shown}: timestamps are whole microseconds; write it without the point"
        return f"{key} is {shown}: timestamps are whole microseconds; from seconds: round(t * 1e6)"
    message = item["msg"].removeprefix("Value error, ")
    return f"{key or 'the file'} is {shown}: {message[:1].lower()}{message[1:]}"
