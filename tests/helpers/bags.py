"""Bags of ROS 1 and ROS 2 in all containers: a vehicle that turns, a camera, a LiDAR that spins, transforms."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from drivesplat.cli.__main__ import main
from drivesplat.scene.rigid import apply, inverse, rigid

CONTAINERS = ("ros1", "sqlite", "mcap")
START = 1_700_000_000_000_000
"""Microseconds."""
SIZE = (64, 48)
K = [[50.0, 0.0, 31.0], [0.0, 52.0, 24.0], [0.0, 0.0, 1.0]]
LENS = [-0.05, 0.01, 0.001, -0.002, 0.0]
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CAMERA_LINK = rigid(Rotation.from_euler("zy", [0.1, 0.05]).as_matrix(), np.array([1.7, 0.1, 1.5]))
CAMERA = CAMERA_LINK @ rigid(OPTICAL, np.zeros(3))
LIDAR = rigid(Rotation.from_euler("z", -0.3).as_matrix(), np.array([0.9, 0.0, 1.8]))
REVOLUTION = 100_000
IMAGE, CLOUD, INFO = "/front/image_raw/compressed", "/top/points", "/front/camera_info"
TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


@cache
def store(ros1: bool) -> Any:
    if not ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    found = get_typestore(Stores.ROS1_NOETIC)
    found.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))
    return found


@dataclass
class Messages:
    """Makes messages of ROS 1 or ROS 2."""

    ros1: bool = False

    def of(self, kind: str, **values: Any) -> Any:
        found = store(self.ros1).types[kind.replace("/", "/msg/")]
        names = {one[0] for one in store(self.ros1).fielddefs[kind.replace("/", "/msg/")][1]}
        return found(**{name if name in names else name.upper(): value for name, value in values.items()})

    def header(self, stamp: int, frame: str) -> Any:
        time = self.of("builtin_interfaces/Time", sec=stamp // 10**6, nanosec=stamp % 10**6 * 1000)
        return self.of("std_msgs/Header", stamp=time, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def vector(self, values: Iterable[float], kind: str = "Vector3") -> Any:
        return self.of(f"geometry_msgs/{kind}", **dict(zip("xyz", map(float, values), strict=True)))

    def turn(self, pose: np.ndarray) -> Any:
        values = Rotation.from_matrix(pose[:3, :3]).as_quat()
        return self.of("geometry_msgs/Quaternion", **dict(zip("xyzw", map(float, values), strict=True)))

    def transforms(self, stamp: int, *edges: tuple[str, str, np.ndarray]) -> Any:
        found = [
            self.of(
                "geometry_msgs/TransformStamped", header=self.header(stamp, parent), child_frame_id=child,
                transform=self.of(
                    "geometry_msgs/Transform", translation=self.vector(pose[:3, 3]), rotation=self.turn(pose)
                ),
            )
            for parent, child, pose in edges
        ]  # fmt: skip
        return self.of("tf2_msgs/TFMessage", transforms=found)

    def odometry(self, stamp: int, pose: np.ndarray, frame: str = "odom", child: str = "base_link") -> Any:
        place = self.of("geometry_msgs/Pose", position=self.vector(pose[:3, 3], "Point"), orientation=self.turn(pose))
        twist = self.of("geometry_msgs/Twist", linear=self.vector([0] * 3), angular=self.vector([0] * 3))
        return self.of(
            "nav_msgs/Odometry", header=self.header(stamp, frame), child_frame_id=child,
            pose=self.of("geometry_msgs/PoseWithCovariance", pose=place, covariance=np.zeros(36)),
            twist=self.of("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip

    def compressed(self, stamp: int, frame: str, data: bytes, form: str = "jpeg") -> Any:
        array = np.frombuffer(data, dtype=np.uint8)
        return self.of("sensor_msgs/CompressedImage", header=self.header(stamp, frame), format=form, data=array)

    def raw(self, stamp: int, frame: str, encoding: str, size: tuple[int, int], rows: np.ndarray) -> Any:
        """An Image of rows of bytes (h, step)."""
        return self.of(
            "sensor_msgs/Image", header=self.header(stamp, frame), height=size[1], width=size[0], encoding=encoding,
            is_bigendian=0, step=rows.shape[1], data=rows.reshape(-1),
        )  # fmt: skip

    def info(self, stamp: int, frame: str, **changes: Any) -> Any:
        region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        region |= changes.pop("roi", {})
        values = {
            "height": SIZE[1], "width": SIZE[0], "distortion_model": "plumb_bob", "d": LENS, "k": np.ravel(K),
            "r": np.eye(3).ravel(), "p": np.column_stack([K, np.zeros(3)]).ravel(), "binning_x": 0, "binning_y": 0,
        } | changes  # fmt: skip
        values |= {name: np.asarray(values[name], dtype=np.float64) for name in "dkrp"}
        roi = self.of("sensor_msgs/RegionOfInterest", **region)
        return self.of("sensor_msgs/CameraInfo", header=self.header(stamp, frame), roi=roi, **values)

    def cloud(self, stamp: int, frame: str, rows: np.ndarray, **changes: Any) -> Any:
        """A PointCloud2 of structured rows."""
        fields = [
            self.of("sensor_msgs/PointField", name=name, offset=kind[1], datatype=TYPES[kind[0].str[1:]], count=1)
            for name, kind in rows.dtype.fields.items()
        ]
        values = {
            "height": 1, "width": len(rows), "fields": fields, "is_bigendian": False, "is_dense": True,
            "point_step": rows.dtype.itemsize, "row_step": rows.nbytes,
            "data": np.frombuffer(rows.tobytes(), dtype=np.uint8),
        } | changes  # fmt: skip
        return self.of("sensor_msgs/PointCloud2", header=self.header(stamp, frame), **values)


def ego(stamp: float) -> np.ndarray:
    """The vehicle in the map: 8 m/s, in a curve of 40 m."""
    angle = 0.2 * (stamp - START) * 1e-6
    place = np.array([100 + 40 * np.sin(angle), 50 + 40 * (1 - np.cos(angle)), 2.0])
    return rigid(Rotation.from_euler("z", angle).as_matrix(), place)


WALL = np.array([[100 + 3.0 * i, 58.0, 2.5 + 0.1 * (i % 7)] for i in range(60)])
"""Static points in the map, one for each firing."""
OUSTER = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 16, 20, 26],
        "itemsize": 48,
    }
)


def sweep_rows(stamp: int) -> np.ndarray:
    """A sweep of the wall from `stamp` on, each point where the LiDAR is at its own time."""
    rows = np.zeros(len(WALL), dtype=OUSTER)
    rows["t"] = np.linspace(0, 99_000_000, len(WALL)).astype(np.uint32)
    for i, row in enumerate(rows):
        local = apply(inverse(ego(stamp + row["t"] * 1e-3) @ LIDAR), WALL[i][None])[0]
        rows["x"][i], rows["y"][i], rows["z"][i] = local
    rows["intensity"], rows["ring"] = np.arange(len(WALL)) % 200, np.arange(len(WALL)) % 4
    return rows


def jpeg(number: int, mode: str = "RGB") -> bytes:
    file = BytesIO()
    shade = (40 * number % 250, 90, 120) if mode == "RGB" else 40 * number % 250
    Image.new(mode, SIZE, shade).save(file, format="JPEG")
    return file.getvalue()


@dataclass
class TestBag:
    """The messages of a bag: (topic, log time in microseconds, message)."""

    __test__ = False
    make: Messages
    messages: list[tuple[str, int, Any]] = field(default_factory=list)

    @classmethod
    def recorded(cls, ros1: bool = False, seconds: float = 1.0, delay: int = 5_000) -> "TestBag":
        """Images and sweeps at 10 Hz, tf at 50 Hz from before the first to after the last one."""
        make = Messages(ros1)
        bag, end = cls(make), START + round(seconds * 1e6)
        static = make.transforms(
            START, ("base_link", "top", LIDAR), ("base_link", "front", CAMERA_LINK),
            ("front", "front_optical", rigid(OPTICAL, np.zeros(3))),
        )  # fmt: skip
        bag.messages.append(("/tf_static", START - 200_000, static))
        odom = rigid(Rotation.from_euler("z", 0.4).as_matrix(), np.array([5.0, 6.0, 0.0]))
        for stamp in range(START - 150_000, end + 200_000, 20_000):
            tf = make.transforms(stamp, ("map", "odom", odom), ("odom", "base_link", inverse(odom) @ ego(stamp)))
            bag.messages.append(("/tf", stamp + delay, tf))
        for number, stamp in enumerate(range(START, end, REVOLUTION)):
            bag.messages.append((IMAGE, stamp + delay, make.compressed(stamp, "front_optical", jpeg(number))))
            bag.messages.append((INFO, stamp + delay, make.info(stamp, "front_optical")))
            bag.messages.append((CLOUD, stamp + delay, make.cloud(stamp, "top", sweep_rows(stamp))))
        return bag

    def without(self, *topics: str) -> "TestBag":
        return TestBag(self.make, [one for one in self.messages if one[0] not in topics])

    def changed(self, topic: str, change: Any) -> "TestBag":
        """With `change(message)` in place of each message on a topic."""
        return TestBag(self.make, [(t, log, change(m) if t == topic else m) for t, log, m in self.messages])

    def write(self, folder: Path, container: str = "mcap") -> Path:
        """Writes the bag; returns its path: a file, of SQLite a folder."""
        types, ordered = store(self.make.ros1), sorted(self.messages, key=lambda one: one[1])
        if container == "ros1":
            path = folder / "drive.bag"
            writer: Any = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if container == "mcap" else StoragePlugin.SQLITE3
            path, writer = folder / "drive", Writer2(folder / "drive", version=9, storage_plugin=plugin)
        known: dict[str, Any] = {}
        with writer:
            for topic, log, message in ordered:
                kind = message.__msgtype__
                if topic not in known:
                    known[topic] = writer.add_connection(topic, kind, typestore=types)
                serialize = types.serialize_ros1 if self.make.ros1 else types.serialize_cdr
                writer.write(known[topic], 1000 * log, serialize(message, kind))
        return path / "drive.mcap" if container == "mcap" else path


def imported(path: Path, folder: Path, *options: str, edit: Any = None) -> int:
    """Proposes a map for a bag, changes its text by `edit`, and imports the bag into folder/out. Returns the status."""
    topics = folder / "topics.yaml"
    topics.unlink(missing_ok=True)
    if status := main(["import", "bag", str(path), "--propose", str(topics), *options]):
        return status
    if edit:
        topics.write_text(edit(topics.read_text()))
    return main(["import", "bag", str(path), "--map", str(topics), "--out", str(folder / "out"), *options])
