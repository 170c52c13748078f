"""A recording of ROS 2 as one MCAP file, by rosbags."""

import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from drivesplat.export.ros_messages import ros_types
from drivesplat.io.storage import ABANDONED_SECONDS, atomic_path

ROSBAG2_VERSION = 8
"""The version of rosbag2's metadata: the last one whose qualities of service Humble and Iron read, too."""
LATCHED = "/tf_static"
"""The topic whose last message also late subscribers get."""
DEPTH = 10
"""Messages that a subscriber may lag behind."""


class McapFile:
    """An MCAP file that is being written. Messages are written as they come; a chunk of about 1 MB is kept."""

    def __init__(self, writer: Any):
        self._writer, self._connections = writer, {}
        self.counts: dict[str, int] = {}
        """The number of messages by topic."""

    def write(self, topic: str, stamp: int, message: Any) -> None:
        """Writes a message. `stamp` in microseconds is its log time."""
        types = ros_types()
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, message.__msgtype__, typestore=types, offered_qos_profiles=[_quality(topic == LATCHED)]
            )
        self._writer.write(self._connections[topic], 1000 * stamp, types.serialize_cdr(message, message.__msgtype__))
        self.counts[topic] = self.counts.get(topic, 0) + 1


@contextmanager
def mcap_file(path: Path, notes: dict[str, str]) -> Iterator[McapFile]:
    """A file that appears at `path` when the context ends without an exception. `notes` go into the `custom_data` of
    rosbag2's metadata. Equal messages and notes give equal bytes, with one version of rosbags.

    Raises RequestError where rosbags is missing; ResultError, naming `path`, where the disk is full or the folder
    cannot be written.
    """
    ros_types()
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    with atomic_path(path) as aside:
        _remove_abandoned(path)
        # rosbags writes a folder, and its file into it by the name of the folder, which the metadata repeat
        with TemporaryDirectory(prefix=f".{path.stem}.", suffix=".partial", dir=path.parent) as folder:
            writer = Writer(Path(folder) / path.stem, version=ROSBAG2_VERSION, storage_plugin=StoragePlugin.MCAP)
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            for name, value in notes.items():
                writer.set_custom_data(name, value)
            with writer:
                yield McapFile(writer)
            (Path(folder) / path.stem / f"{path.stem}.mcap").replace(aside)


def _remove_abandoned(path: Path) -> None:
    """Removes the folders of killed writers: those that have not been modified for an hour."""
    for folder in path.parent.glob(".*.partial"):
        if folder.is_dir() and re.fullmatch(rf"\.{re.escape(path.stem)}\.\w+\.partial", folder.name):
            with suppress(OSError):
                if time.time() - folder.stat().st_mtime > ABANDONED_SECONDS:
                    shutil.rmtree(folder)


def _quality(latched: bool) -> Any:
    """The quality of service that a publisher offers: reliable, without deadlines; as tf2 does, transient-local where
    it is `latched`."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    infinite = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST, 1 if latched else DEPTH, QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        infinite, infinite, QosLiveliness.AUTOMATIC, infinite, False,
    )  # fmt: skip
