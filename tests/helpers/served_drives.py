"""Result folders of drives made by hand, a client of the sensor service that speaks AlpaSim's messages by the copy of
carla-driver-interface, and requests for images."""

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from scipy.spatial.transform import Rotation

from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.io.array_file import write_arrays
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import write_checkpoint
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.rigid import interpolate
from drivesplat.scene.scene import Scene, write_scene
from drivesplat.serve.server import SensorServer
from helpers.hand_made_drive import K, drive_of
from helpers.hand_made_street import checkpoint_of
from helpers.scanned_street import scan_records
from helpers.trainings import PROVENANCE

SERVICE = sensorsim_pb2.DESCRIPTOR.services_by_name["SensorsimService"]
CAMERA = "CAM_FRONT"
MASKED = [[0.0, 0.75], [1.0, 0.75], [1.0, 1.0], [0.0, 1.0]]
"""The outline of the vehicle's own body: the lowest quarter of the image."""
Pixels = np.ndarray


def write_method(folder: Path, scene: Scene, model: SplatModel, scans: bool = False) -> TrainedDrive:
    """Writes what `drivesplat.open` reads of a method into `folder`, and returns the drive."""
    folder.mkdir(parents=True)
    drive = drive_of(scene, model, folder.parent, scan_records(scene) if scans else None)
    write_scene(folder.parent / "scene.json", scene)
    write_arrays(folder.parent / "parser.npz", dataclasses.asdict(drive.record))
    write_checkpoint(
        folder / "checkpoint.npz", dataclasses.replace(checkpoint_of(model), provenance=PROVENANCE)
    )  # fmt: skip
    return drive


def write_mask(scene_folder: Path) -> None:
    """The ego mask of the camera of a scene."""
    own = {"source": "polygons", "outlines": [MASKED], "share": 0.25, "why_null": None}
    write_json(scene_folder / "own_car.json", {"cameras": {CAMERA: own}, "provenance": PROVENANCE})


class SensorClient:
    """A client at an address: `client.render_rgb(request)`, and so on."""

    def __init__(self, address: str, certificate: bytes | None = None):
        options = [("grpc.max_receive_message_length", 64 << 20), ("grpc.max_send_message_length", 64 << 20)]
        if certificate is None:
            self.channel = grpc.insecure_channel(address, options)
        else:
            credentials = grpc.ssl_channel_credentials(certificate)
            override = ("grpc.ssl_target_name_override", "localhost")
            self.channel = grpc.secure_channel(address, credentials, [*options, override])

    def __getattr__(self, name: str) -> Any:
        if name not in SERVICE.methods_by_name:
            raise AttributeError(name)
        reply = SERVICE.methods_by_name[name].output_type._concrete_class
        return self.channel.unary_unary(
            f"/{SERVICE.full_name}/{name}", lambda message: message.SerializeToString(), reply.FromString
        )

    def raw(self, name: str, request: bytes) -> bytes:
        """Calls a method with any bytes."""
        return self.channel.unary_unary(f"/{SERVICE.full_name}/{name}")(request)

    def image(self, request: Any) -> Pixels:
        """The image (h, w, 3) of a request for a PNG or a JPEG."""
        return decoded(self.render_rgb(request).image_bytes)


@contextmanager
def served(*paths: Path, **options: Any) -> Iterator[tuple[SensorServer, SensorClient]]:
    """A server on a free port of the loopback, and a client of it."""
    server = SensorServer(paths, "127.0.0.1:0", device="cpu", **options)
    client = SensorClient(server.address)
    try:
        yield server, client
    finally:
        client.channel.close()
        server.close(None)


def decoded(image: bytes) -> Pixels:
    """An encoded image (h, w, 3), red first."""
    return cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def pose_of(message: Any) -> np.ndarray:
    """A message's pose as a matrix (4, 4)."""
    pose = np.eye(4)
    pose[:3, 3] = message.vec.x, message.vec.y, message.vec.z
    quat = message.quat
    pose[:3, :3] = Rotation.from_quat([quat.x, quat.y, quat.z, quat.w]).as_matrix()
    return pose


def message_of(pose: np.ndarray) -> Any:
    """A matrix (4, 4) as a message."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    vec = common_pb2.Vec3(**dict(zip("xyz", pose[:3, 3], strict=True)))
    return common_pb2.Pose(vec=vec, quat=common_pb2.Quat(w=w, x=x, y=y, z=z))


def pair_of(start: np.ndarray, end: np.ndarray) -> Any:
    """The poses of a frame."""
    return sensorsim_pb2.PosePair(start_pose=message_of(start), end_pose=message_of(end))


def object_of(track: str, start: np.ndarray, end: np.ndarray) -> Any:
    """A dynamic object."""
    return sensorsim_pb2.DynamicObject(track_id=track, pose_pair=pair_of(start, end))


def motion_of(pair: Any, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """The pose in the middle of a frame, and the velocity (6,) along its axes, by the messages of its ends."""
    start, end = pose_of(pair.start_pose), pose_of(pair.end_pose)
    middle = interpolate(start, end, 0.5)
    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    return middle, np.concatenate([middle[:3, :3].T @ (end - start)[:3, 3], turn]) / seconds


def pinhole(shutter: int = sensorsim_pb2.GLOBAL, intrinsics: np.ndarray = K, size: tuple[int, int] = (64, 48)) -> Any:
    """The specification of the camera of drives made by hand."""
    lens = sensorsim_pb2.OpenCVPinholeCameraParam(
        focal_length_x=intrinsics[0, 0], focal_length_y=intrinsics[1, 1],
        principal_point_x=intrinsics[0, 2], principal_point_y=intrinsics[1, 2],
    )  # fmt: skip
    return sensorsim_pb2.CameraSpec(
        opencv_pinhole_param=lens, logical_id=CAMERA, resolution_w=size[0], resolution_h=size[1], shutter_type=shutter
    )


def image_request(
    scene_id: str, frame: tuple[int, int], poses: tuple[np.ndarray, np.ndarray], objects: Sequence[Any] = (),
    spec: Any = None, size: tuple[int, int] = (64, 48), **fields: Any,
) -> Any:  # fmt: skip
    """A request for a PNG of a frame from its start to its end in microseconds."""
    given = {"image_format": sensorsim_pb2.PNG, **fields}
    return sensorsim_pb2.RGBRenderRequest(
        scene_id=scene_id, resolution_w=size[0], resolution_h=size[1],
        camera_intrinsics=pinhole() if spec is None else spec, frame_start_us=frame[0], frame_end_us=frame[1],
        sensor_pose=pair_of(*poses), dynamic_objects=objects, **given,
    )  # fmt: skip
