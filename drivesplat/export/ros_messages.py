"""ROS 2 messages of a drive, by rosbags. Stamps are microseconds; lengths metres, angles radians.

vision_msgs is none of rosbags' own packages: its definitions, those of version 4, stand here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt16, UInt32
from scipy.spatial.transform import Rotation

from drivesplat.errors import RequestError
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.sensors import Camera

MAP, BASE = "map", "base_link"
"""The frames of the world, whose origin is near, and of the ego vehicle."""
VISION_MSGS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
UINT16, UINT32, FLOAT32 = 4, 6, 7
"""Types of a PointField."""
CLOUD_COLUMNS = {
    "x": (0, FLOAT32, "<f4"),
    "y": (4, FLOAT32, "<f4"),
    "z": (8, FLOAT32, "<f4"),
    "intensity": (12, FLOAT32, "<f4"),
    "t": (16, UINT32, "<u4"),
    "ring": (20, UINT16, "<u2"),
}
"""Offset in bytes, type and NumPy type of the columns of a point cloud."""
POINT_STEP = 24
"""Bytes of a point."""
CUBE, ADD, DELETE_ALL = 1, 0, 3
"""Types and actions of a marker."""
PEOPLE, TWO_WHEELERS, VEHICLES, OTHERS = (0.9, 0.3, 0.9), (0.2, 0.7, 0.9), (1.0, 0.6, 0.1), (0.6, 0.6, 0.6)
"""Colours of boxes."""
COLORS = {
    ObjectClass.PEDESTRIAN: PEOPLE,
    ObjectClass.RIDER: PEOPLE,
    ObjectClass.MOTORCYCLE: TWO_WHEELERS,
    ObjectClass.BICYCLE: TWO_WHEELERS,
    ObjectClass.ANIMAL: OTHERS,
    ObjectClass.OTHER_MOVABLE: OTHERS,
}
"""Those of classes that are no vehicles."""
OPACITY = 0.5


@dataclass(frozen=True, eq=False)
class PlacedBox:
    """An object at a time: its `number` in the drive, id, class, `size` (length, width, height), and the pose of the
    centre of its box in the map."""

    number: int
    id: str
    object_class: ObjectClass
    size: Float64[np.ndarray, "3"]
    object_to_map: Float64[np.ndarray, "4 4"]

    @cached_property
    def pose(self) -> Any:
        return _pose(self.object_to_map)


@cache
def ros_types() -> Any:
    """The types of messages, those of ROS 2 Humble, which later distributions share. Raises RequestError where rosbags
    is missing."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise RequestError("MCAP files need the package rosbags: pip install 'drivesplat[ros]'") from None
    types = get_typestore(Stores.ROS2_HUMBLE)
    for name, definition in VISION_MSGS.items():
        types.register(get_types_from_msg(definition, name))
    return types


def _of(kind: str, /, **fields: Any) -> Any:
    """A message of the type `package/Name`."""
    return ros_types().types[kind.replace("/", "/msg/")](**fields)


def _header(stamp: int, frame: str) -> Any:
    seconds, rest = divmod(stamp, 1_000_000)
    time = _of("builtin_interfaces/Time", sec=seconds, nanosec=1000 * rest)
    return _of("std_msgs/Header", stamp=time, frame_id=frame)


def _vector(values: Sequence[float] | np.ndarray, kind: str = "Vector3") -> Any:
    return _of(f"geometry_msgs/{kind}", **dict(zip("xyz", map(float, values), strict=True)))


def _quaternion(rotation: np.ndarray) -> Any:
    """A rotation matrix (3, 3) as a unit quaternion with w >= 0."""
    values = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return _of("geometry_msgs/Quaternion", **dict(zip("xyzw", map(float, values), strict=True)))


def _pose(matrix: np.ndarray) -> Any:
    orientation = _quaternion(matrix[:3, :3])
    return _of("geometry_msgs/Pose", position=_vector(matrix[:3, 3], "Point"), orientation=orientation)


def _uncertain(pose: Any) -> Any:
    """A pose with covariances of 0: unknown."""
    return _of("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36))


def transforms(stamp: int, parent: str, children: Mapping[str, np.ndarray]) -> Any:
    """TFMessage: the poses (4, 4) of frames, by their names, in the frame `parent`."""
    found = [
        _of(
            "geometry_msgs/TransformStamped", header=_header(stamp, parent), child_frame_id=child,
            transform=_of(
                "geometry_msgs/Transform", translation=_vector(pose[:3, 3]), rotation=_quaternion(pose[:3, :3])
            ),
        )
        for child, pose in children.items()
    ]  # fmt: skip
    return _of("tf2_msgs/TFMessage", transforms=found)


def odometry(stamp: int, ego_to_map: Float64[np.ndarray, "4 4"], velocity: Float64[np.ndarray, "6"]) -> Any:
    """Odometry of the ego vehicle: its pose in the map, and its linear (m/s), then angular velocity (rad/s) along its
    own axes. Covariances are 0: unknown."""
    twist = _of("geometry_msgs/Twist", linear=_vector(velocity[:3]), angular=_vector(velocity[3:]))
    return _of(
        "nav_msgs/Odometry", header=_header(stamp, MAP), child_frame_id=BASE, pose=_uncertain(_pose(ego_to_map)),
        twist=_of("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip


def jpeg_image(stamp: int, frame: str, data: bytes) -> Any:
    """CompressedImage of the bytes of a JPEG file."""
    array = np.frombuffer(data, dtype=np.uint8)
    return _of("sensor_msgs/CompressedImage", header=_header(stamp, frame), format="jpeg", data=array)


def camera_info(stamp: int, frame: str, camera: Camera) -> Any:
    """CameraInfo of a camera. Its intrinsics count pixels as ROS does: (0, 0) is the centre of the first one."""
    K = np.asarray(camera.intrinsics, dtype=np.float64)
    coefficients = np.zeros(5) if camera.distortion is None else np.asarray(camera.distortion, dtype=np.float64)
    model: str = camera.distortion_model
    if model == "none":
        model, coefficients = "plumb_bob", np.zeros(5)
    elif model == "opencv":
        model = "plumb_bob" if len(coefficients) <= 5 else "rational_polynomial"
        coefficients = np.append(coefficients, np.zeros(max(0, 5 - len(coefficients))))
    elif model == "fisheye":
        model = "equidistant"
    region = _of("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return _of(
        "sensor_msgs/CameraInfo", header=_header(stamp, frame), height=camera.height, width=camera.width,
        distortion_model=model, d=coefficients, k=K.reshape(9), r=np.eye(3).reshape(9),
        p=np.column_stack([K, np.zeros(3)]).reshape(12), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip


def point_cloud(
    stamp: int,
    frame: str,
    points: Float32[np.ndarray, "n 3"],
    intensity: Float32[np.ndarray, " n"] | None,
    ring: UInt16[np.ndarray, " n"] | None,
    t: UInt32[np.ndarray, " n"] | None,
) -> Any:
    """PointCloud2 of points in `frame`, with the columns that are known: intensity, ring (index of the beam) and t
    (nanoseconds after the stamp)."""
    columns = {**dict(zip("xyz", points.T, strict=True)), "intensity": intensity, "t": t, "ring": ring}
    known = {name: values for name, values in columns.items() if values is not None}
    layout = {name: CLOUD_COLUMNS[name] for name in known}
    offsets, kinds, types = ([entry[i] for entry in layout.values()] for i in range(3))
    record = np.dtype({"names": list(layout), "formats": types, "offsets": offsets, "itemsize": POINT_STEP})
    rows = np.zeros(len(points), dtype=record)
    for name, values in known.items():
        rows[name] = values
    fields = [
        _of("sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=1)
        for name, offset, kind in zip(layout, offsets, kinds, strict=True)
    ]
    return _of(
        "sensor_msgs/PointCloud2", header=_header(stamp, frame), height=1, width=len(points), fields=fields,
        is_bigendian=False, point_step=POINT_STEP, row_step=POINT_STEP * len(points),
        data=np.frombuffer(rows.tobytes(), dtype=np.uint8), is_dense=True,
    )  # fmt: skip


def markers(stamp: int, boxes: Sequence[PlacedBox], lifetime_s: float) -> Any:
    """MarkerArray that replaces all boxes by these: a namespace per class, the number of the object as id. What no
    later message replaces vanishes after `lifetime_s` seconds."""
    whole = int(lifetime_s)
    lifetime = _of("builtin_interfaces/Duration", sec=whole, nanosec=round((lifetime_s - whole) * 1e9))
    found = [_marker(stamp, "", 0, DELETE_ALL, _pose(np.eye(4)), np.zeros(3), OTHERS, lifetime)]
    for box in boxes:
        color = COLORS.get(box.object_class, VEHICLES)
        of_class = box.object_class.value
        found.append(_marker(stamp, of_class, box.number, ADD, box.pose, box.size, color, lifetime))
    return _of("visualization_msgs/MarkerArray", markers=found)


def _marker(
    stamp: int, namespace: str, number: int, action: int, pose: Any, size: np.ndarray,
    color: tuple[float, float, float], lifetime: Any,
) -> Any:  # fmt: skip
    none = np.zeros(0, dtype=np.uint8)
    return _of(
        "visualization_msgs/Marker", header=_header(stamp, MAP), ns=namespace, id=number, type=CUBE, action=action,
        pose=pose, scale=_vector(size),
        color=_of("std_msgs/ColorRGBA", **dict(zip("rgba", (*color, OPACITY), strict=True))), lifetime=lifetime,
        frame_locked=False, points=[], colors=[], texture_resource="",
        texture=_of("sensor_msgs/CompressedImage", header=_header(0, ""), format="", data=none), uv_coordinates=[],
        text="", mesh_resource="", mesh_file=_of("visualization_msgs/MeshFile", filename="", data=none),
        mesh_use_embedded_materials=False,
    )  # fmt: skip


def detections(stamp: int, boxes: Sequence[PlacedBox]) -> Any:
    """Detection3DArray: of every box its id, its class with score 1, its pose and its size."""
    header = _header(stamp, MAP)
    found = []
    for box in boxes:
        certain = _of("vision_msgs/ObjectHypothesis", class_id=box.object_class.value, score=1.0)
        result = _of("vision_msgs/ObjectHypothesisWithPose", hypothesis=certain, pose=_uncertain(box.pose))
        bounds = _of("vision_msgs/BoundingBox3D", center=box.pose, size=_vector(box.size))
        found.append(_of("vision_msgs/Detection3D", header=header, results=[result], bbox=bounds, id=box.id))
    return _of("vision_msgs/Detection3DArray", header=header, detections=found)
