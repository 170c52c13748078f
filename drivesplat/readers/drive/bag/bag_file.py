"""Bags of ROS 1 (.bag) and ROS 2 (SQLite, MCAP), read by rosbags message by message."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from drivesplat.errors import DatasetError, RequestError
from drivesplat.readers.record_names import shown

MISSING = "ROS bags need the package rosbags: pip install 'drivesplat[ros]'"
SUFFIXES = (".bag", ".mcap", ".db3")
_STAMPED = ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id")
_PLACE = tuple(f"{of}.{axis}" for of, axes in (("position", "xyz"), ("orientation", "xyzw")) for axis in axes)
_MOVED = tuple(f"{of}.{axis}" for of, axes in (("translation", "xyz"), ("rotation", "xyzw")) for axis in axes)
_FIELDS = {
    "Image": attrgetter(*_STAMPED, "height", "width", "encoding", "step", "data"),
    "CompressedImage": attrgetter(*_STAMPED, "format", "data"),
    "CameraInfo": attrgetter(*_STAMPED, "height", "width", "distortion_model"),
    "PointCloud2": attrgetter(*_STAMPED, "height", "width", "fields", "is_bigendian", "point_step", "row_step", "data"),
    "Odometry": attrgetter(*_STAMPED, "child_frame_id", *(f"pose.pose.{name}" for name in _PLACE)),
}
"""What reads the fields of messages that are used. A bag defines its messages itself, and may lack some."""
_TRANSFORM = attrgetter(*_STAMPED, "child_frame_id", *(f"transform.{name}" for name in _MOVED))
METADATA = "metadata.yaml"
"""The file that makes a folder a bag of ROS 2."""
UNFINISHED = (
    "File end magic is invalid", "Invalid MCAP footer", "Truncated record", "is malformed", "not indexed",
    "index looks damaged", "Invalid argument", "Got only", "Header could not be read",
)  # fmt: skip
"""What rosbags and SQLite say of files that end too early."""
RECOVER = {
    ".bag": "`rosbag reindex` repairs it",
    ".mcap": "`mcap recover` repairs it",
    ".db3": "`sqlite3 FILE .recover` repairs it",
}


@dataclass(frozen=True)
class BagTopic:
    """A topic: its type, such as sensor_msgs/msg/Image, and its number of messages."""

    name: str
    kind: str
    count: int


@dataclass(frozen=True, eq=False)
class BagMessage:
    """A message, not yet deserialized. `log` is the time at which it was recorded, nanoseconds."""

    topic: str
    log: int
    _kind: str
    _data: Any
    _reader: Any

    def content(self) -> Any:
        """The message. Raises DatasetError where its bytes do not fit its type, or the type lacks fields."""
        try:
            found = self._reader.deserialize(self._data, self._kind)
            name = self._kind.rpartition("/")[2]
            if name in _FIELDS:
                _FIELDS[name](found)
            for one in getattr(found, "transforms", ()):
                _TRANSFORM(one)
            return found
        except Exception as error:  # of rosbags, struct and NumPy
            raise DatasetError(f"a message on {self.topic} is damaged ({_reason(error)})") from error


class BagFile:
    """An open bag."""

    def __init__(self, path: Path, reader: Any):
        self.path, self._reader = path, reader
        self.topics: dict[str, BagTopic] = {}
        for one in reader.connections:
            known = self.topics.get(one.topic)
            self.topics[one.topic] = BagTopic(one.topic, one.msgtype, (known.count if known else 0) + one.msgcount)
        self.begin, self.end = int(reader.start_time), int(reader.end_time)
        """The log time of the first message, and that after the last one, in nanoseconds."""

    def messages(self, topics: Sequence[str], begin: int | None = None, end: int | None = None) -> Iterator[BagMessage]:
        """The messages on `topics` in the order of their log times, with log times from `begin` until before `end`.
        Raises DatasetError where the file is damaged."""
        chosen = [one for one in self._reader.connections if one.topic in topics]
        if not chosen:
            return
        with _reading(self.path):
            for one, log, data in self._reader.messages(chosen, begin, end):
                yield BagMessage(one.topic, log, one.msgtype, data, self._reader)

    def of_kind(self, *kinds: str) -> list[BagTopic]:
        """The topics of these types that have messages."""
        return [topic for topic in self.topics.values() if topic.kind in kinds and topic.count]


@contextmanager
def open_bag(path: Path) -> Iterator[BagFile]:
    """The bag at `path`: a .bag, .mcap or .db3 file, or a folder with metadata.yaml or the files of one recording.

    Raises DatasetError where there is none, or it is damaged or empty; RequestError where rosbags is missing.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise RequestError(MISSING) from None
    with _reading(path):  # recordings older than ROS 2 Iron do not hold the definitions of their messages
        reader = AnyReader(_files_of(path), default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    try:
        with _reading(path):
            bag = BagFile(path, reader)
        if not any(topic.count for topic in bag.topics.values()):
            raise DatasetError(f"{path} has no messages")
        yield bag
    finally:
        with _reading(path):
            reader.close()


def _files_of(path: Path) -> list[Path]:
    if not path.exists():
        raise DatasetError(f"{path} is missing")
    if path.is_dir():
        if (path / METADATA).is_file():
            return [path]
        for suffix in SUFFIXES:
            if files := sorted(file for file in path.glob(f"*{suffix}") if file.is_file()):
                return files
        raise DatasetError(f"{path} is no bag: it has no {METADATA}, and no {', '.join(SUFFIXES)} file")
    if not path.is_file():
        raise DatasetError(f"{path} is not a file")
    if path.suffix not in SUFFIXES:
        raise DatasetError(f"{path} is no bag: bags are folders with {METADATA}, and {', '.join(SUFFIXES)} files")
    return [path]


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turns what rosbags raises for damaged files into a DatasetError."""
    try:
        yield
    except (DatasetError, GeneratorExit):
        raise
    except Exception as error:  # of rosbags, SQLite, decompressors, struct and NumPy: no common class
        reason = _reason(error)
        if any(words in reason for words in UNFINISHED):
            inside = [file.suffix for file in sorted(path.iterdir())] if path.is_dir() else [path.suffix]
            repair = next((RECOVER[suffix] for suffix in inside if suffix in RECOVER), "record it anew")
            raise DatasetError(f"{path} is truncated or was not closed ({reason}); {repair}") from error
        if "Profile is not ros2" in reason:
            raise DatasetError(f"{path} holds no messages of ROS 2; convert its channels to ROS 2 first") from error
        raise DatasetError(f"{path} cannot be read as a bag ({reason})") from error


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split())[:200]
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    return f"{type(error).__name__}: {plain}" if plain else type(error).__name__


def frame_name(name: Any) -> str:
    """The name of a frame without the slash that tf of ROS 1 put before it."""
    return str(name).lstrip("/")


def header_stamp(message: Any) -> int:
    """The stamp of a message's header in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def microseconds(nanoseconds: int) -> int:
    """Nanoseconds as the nearest microsecond."""
    return (int(nanoseconds) + 500) // 1000


def listed(names: Any) -> str:
    """Names for a message; 'none' without any."""
    return ", ".join(shown(name).strip("'") for name in names) or "none"
