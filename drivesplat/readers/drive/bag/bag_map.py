"""The map of a bag, topics.yaml: which topics are which sensors, and all that a bag does not say."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, ValidationError, model_validator

from drivesplat.errors import DatasetError
from drivesplat.io.yaml_file import read_yaml
from drivesplat.readers.drive.format import Distortion, DriveRecord, Pose, Row, sentence_of

IDENTITY = Pose(translation=(0.0, 0.0, 0.0), rotation=(1.0, 0.0, 0.0, 0.0))
TF = "tf"
"""As the source of poses: all transforms of the bag."""
MAX_NAME = 100

StampPlace = Literal["start", "middle", "end"]


class Calibration(DriveRecord):
    """The calibration of a camera, for bags without CameraInfo."""

    width: int = Field(ge=1, le=20_000)
    """Pixels."""
    height: int = Field(ge=1, le=20_000)
    """Pixels."""
    K: tuple[Row, Row, Row]
    """Pinhole matrix in pixels; the centre of the first pixel is (0, 0)."""
    distortion: Distortion = Distortion()


class BagCamera(DriveRecord):
    """A camera."""

    images: str
    """The topic of its Image or CompressedImage messages."""
    info: str | None = None
    """The topic of its CameraInfo messages, of which the first one with a K counts."""
    calibration: Calibration | None = None
    """In place of `info`."""
    rectified: bool = False
    """Whether images are rectified: P of the CameraInfo holds then, without distortion."""
    frame: str
    """Its frame in tf."""
    axes: Literal["optical", "forward"] = "optical"
    """The axes of the frame. optical: x right, y down, z forward; forward: x forward, y left, z up."""
    mount: Pose | None = None
    """The frame in that of the vehicle. null: by tf."""
    stamp: StampPlace = "middle"
    """The part of the exposure at which images are stamped; they get the time of its middle."""
    exposure_s: float = Field(0.0, ge=0, le=1)
    """Time of exposure, or from the first line of pixels to the last (seconds)."""


class PointTime(DriveRecord):
    """The times of points."""

    field: str
    unit: Literal["s", "ms", "us", "ns"]
    counts_from: Literal["stamp", "start", "epoch"]
    """What times count from: the stamp of the header, the first point of the sweep, or 1970 on the header's clock."""


class BagLidar(DriveRecord):
    """A LiDAR."""

    points: str
    """The topic of its PointCloud2 messages."""
    frame: str
    """Its frame in tf."""
    mount: Pose | None = None
    """The frame in that of the vehicle. null: by tf."""
    stamp: StampPlace = "start"
    """The part of the revolution at which sweeps are stamped. Only used where times count from `start`."""
    revolution_s: float | None = Field(None, gt=0, le=10)
    """Time of a revolution (seconds). null: unknown."""
    time: PointTime | None = None
    """null: the times of points are not known."""
    motion_compensated: bool
    """Whether all points are where they would have been seen at the stamp."""
    ring: str | None = None
    """The field with the index of the beam."""
    intensity: str | None = None
    """The field with the intensity."""
    intensity_scale: float = Field(1.0, gt=0)
    """The intensity that becomes 1; higher ones become 1, too."""

    @model_validator(mode="after")
    def _times_for_compensation(self) -> "BagLidar":
        if not self.motion_compensated and self.time is None:
            raise ValueError("motion_compensated: false needs the times of points (time)")
        if self.time and self.time.counts_from == "start" and self.stamp != "start" and self.revolution_s is None:
            raise ValueError("counts_from: start needs revolution_s where the stamp is not at the start")
        return self


class KeyFrames(DriveRecord):
    """The times of key frames."""

    sensor: str
    """The camera or LiDAR whose recordings are key frames."""
    min_interval_s: float = Field(0.0, ge=0, le=60)
    """Recordings that follow the last key frame earlier are none."""


class BagMap(DriveRecord):
    """What a bag's topics are."""

    clock: Literal["header", "log"]
    """The times of messages: the stamps of their headers, or the times at which they were recorded."""
    world: str
    """The frame that is the world."""
    vehicle: str
    """The frame that is the vehicle."""
    vehicle_to_ego: Pose = IDENTITY
    """The vehicle's frame in the ego frame, which is on the ground under the rear axle: x forward, y left, z up."""
    poses: str | None
    """'tf', or the topic of Odometry messages. null: there are none, and they will be estimated."""
    cameras: dict[str, BagCamera] = Field(default_factory=dict)
    lidars: dict[str, BagLidar] = Field(default_factory=dict)
    key_frames: KeyFrames
    raw_images: Literal["png", "jpeg"] = "png"
    """How images are stored that were recorded without compression."""

    @model_validator(mode="after")
    def _names(self) -> "BagMap":
        names = [*self.cameras, *self.lidars]
        if len(set(names)) < len(names):
            raise ValueError("a camera and a LiDAR have the same name; rename one")
        for name in names:
            plain = name.replace("_", "").replace("-", "")
            if not (0 < len(name) <= MAX_NAME and plain.isascii() and plain.isalnum()):
                raise ValueError(f"the sensor name {name[:40]!r} must have letters, digits, - and _ only")
        if self.key_frames.sensor not in names:
            raise ValueError(f"key_frames.sensor must be one of: {', '.join(names) or 'none is mapped'}")
        return self

    @property
    def topics(self) -> dict[str, str]:
        """The names of sensors by the topics of their recordings."""
        cameras = {camera.images: name for name, camera in self.cameras.items()}
        return cameras | {lidar.points: name for name, lidar in self.lidars.items()}


@dataclass(frozen=True)
class Decision:
    """A value of a map, and the reason that its comment states."""

    key: str
    value: str
    reason: str


def read_map(path: Path) -> tuple[BagMap, list[Decision]]:
    """The map of a file, and its values with their comments in the order of the file.

    Raises ConfigError where it is no YAML; DatasetError, a sentence on the first fault, where it is no map.
    """
    values = read_yaml(path, "map of topics")
    try:
        found = BagMap.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise DatasetError(f"{path}: {sentence_of(first)}") from None
    if len(found.topics) < len(found.cameras) + len(found.lidars):
        raise DatasetError(f"{path}: two sensors have the same topic; leave one out")
    text = path.read_text(encoding="utf-8")
    return found, list(_decisions(yaml.compose(text, yaml.SafeLoader), text.splitlines()))


def _decisions(node: Any, lines: list[str], above: str = "") -> Iterator[Decision]:
    """The scalar values and lists of a YAML tree with the comments at the ends of their lines."""
    if isinstance(node, yaml.MappingNode) and (not node.flow_style or not above):
        for key, value in node.value:
            yield from _decisions(value, lines, f"{above}.{key.value}".removeprefix("."))
        return
    begin, end = node.start_mark, node.end_mark
    if begin.line == end.line:
        text, rest = lines[begin.line][begin.column : end.column], lines[end.line][end.column :]
    else:
        text, rest = " ".join(line.strip() for line in lines[begin.line : end.line + 1]), ""
    _, mark, reason = rest.partition("#")
    yield Decision(above, text.strip(), reason.strip() if mark else "")


def quoted(text: str) -> str:
    """A text as a scalar of YAML on one line."""
    return (
        text if re.fullmatch(r"[A-Za-z_/][A-Za-z0-9_/.-]*", text) and yaml.safe_load(text) == text else json.dumps(text)
    )
