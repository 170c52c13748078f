"""MCAP files as rosbags reads them, and as the bytes of their records."""

import struct
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from drivesplat.scene.rigid import rigid

KINDS = {7: "<f4", 6: "<u4", 4: "<u2"}


@dataclass
class Recording:
    """The messages of a file by topic, each with its log time in nanoseconds, in the order of the file; types and
    qualities of service by topic."""

    messages: dict[str, list[tuple[int, Any]]] = field(default_factory=lambda: defaultdict(list))
    types: dict[str, str] = field(default_factory=dict)
    qualities: dict[str, Any] = field(default_factory=dict)
    order: list[tuple[int, str]] = field(default_factory=list)

    @classmethod
    def of(cls, path: Path) -> "Recording":
        found = cls()
        with AnyReader([path]) as reader:
            for connection in reader.connections:
                found.types[connection.topic] = connection.msgtype
                (found.qualities[connection.topic],) = connection.ext.offered_qos_profiles
            for connection, time, raw in reader.messages():
                found.messages[connection.topic].append((time, reader.deserialize(raw, connection.msgtype)))
                found.order.append((time, connection.topic))
        return found

    def all(self, topic: str) -> list[Any]:
        return [message for _, message in self.messages[topic]]

    @property
    def static(self) -> dict[str, np.ndarray]:
        """The poses of sensors in base_link."""
        (message,) = self.all("/tf_static")
        return {one.child_frame_id: pose_of(one.transform) for one in message.transforms}

    @property
    def ego(self) -> dict[int, np.ndarray]:
        """The poses of base_link in the map by their stamps in nanoseconds."""
        found = {}
        for message in self.all("/tf"):
            for one in message.transforms:
                if one.child_frame_id == "base_link":
                    assert one.header.frame_id == "map" and nanoseconds(one.header) not in found
                    found[nanoseconds(one.header)] = pose_of(one.transform)
        return found

    def points(self, topic: str, number: int) -> np.ndarray:
        """The points (n, 3) of a cloud in the map, by the transforms at its stamp."""
        cloud = self.all(topic)[number]
        columns, frame = columns_of(cloud), cloud.header.frame_id
        pose = self.ego[nanoseconds(cloud.header)] @ self.static[frame]
        local = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float64)
        return local @ pose[:3, :3].T + pose[:3, 3]


def nanoseconds(header: Any) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def pose_of(message: Any) -> np.ndarray:
    """A Transform or a Pose as a matrix (4, 4)."""
    place, turn = (
        (message.translation, message.rotation)
        if hasattr(message, "translation")
        else (message.position, message.orientation)
    )
    matrix = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    return rigid(matrix, np.array([place.x, place.y, place.z]))


def columns_of(cloud: Any) -> np.ndarray:
    """The points of a cloud as rows with named columns."""
    assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data) and cloud.height == 1
    layout = {
        "names": [one.name for one in cloud.fields],
        "formats": [KINDS[one.datatype] for one in cloud.fields],
        "offsets": [one.offset for one in cloud.fields],
        "itemsize": cloud.point_step,
    }
    return np.frombuffer(cloud.data.tobytes(), dtype=np.dtype(layout))


def records_of(data: bytes) -> list[tuple[int, bytes]]:
    """The records of an MCAP file, or of a chunk without its magic: opcode and content."""
    found, at = [], 0
    while at < len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        found.append((opcode, data[at + 9 : at + 9 + length]))
        assert len(found[-1][1]) == length
        at += 9 + length
    return found
