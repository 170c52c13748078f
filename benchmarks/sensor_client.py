"""A client of the sensor service, as AlpaSim's runtime is one, and a server in a process of its own."""

import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.scene.pose_path import PosePath
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import box_at
from drivesplat.serve.messages import METHODS, SERVICE, wire
from drivesplat.serve.poses import pose_message

SHUTTER_US = 17_000
YAWS = (0.0, 55.0, -55.0)
"""Directions of the cameras in degrees to the left."""
MESSAGE_BYTES = 64 << 20
FORMATS = {"jpeg": wire.ImageFormat.JPEG, "png": wire.ImageFormat.PNG}
DEADLINE_S = 300.0
"""Deadline of AlpaSim's runtime for a call."""
Listed = Literal["all", "half", "none"]
"""Which of the objects a request lists: `half` is every second one."""
LISTED: tuple[Listed, ...] = ("all", "half", "none")


@dataclass(frozen=True)
class RunningServer:
    """A server in a process of its own."""

    pid: int
    address: str
    metrics: str

    def model_seconds(self) -> float:
        """Seconds in which a model was in use."""
        with urllib.request.urlopen(self.metrics) as page:
            text = page.read().decode()
        found = re.search(r"^drivesplat_model_seconds_total (\S+)", text, re.MULTILINE)
        assert found is not None
        return float(found[1])

    def memory_mb(self) -> float:
        """Resident memory in MB."""
        status = Path(f"/proc/{self.pid}/status").read_text(encoding="utf-8")
        return int(re.findall(r"VmRSS:\s+(\d+) kB", status)[0]) / 1000.0

    def open_files(self) -> int:
        """Number of open files and sockets."""
        return len(list(Path(f"/proc/{self.pid}/fd").iterdir()))


@contextmanager
def running_server(paths: Sequence[Path], device: str, options: Sequence[str] = ()) -> Iterator[RunningServer]:
    """A server of drives, until the block ends."""
    command = [sys.executable, "-m", "drivesplat.cli", "serve", *map(str, paths), "--address", "127.0.0.1:0"]
    command += ["--metrics-port", "0", "--device", device, *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        said, metrics = "", ""
        while " serves " not in said:
            said = process.stdout.readline()
            if not said:
                raise SystemExit(f"the server ended with status {process.wait()}")
            metrics = said.rpartition(" ")[2].strip() if " figures at " in said else metrics
        yield RunningServer(process.pid, said.split()[2], metrics)
    finally:
        process.terminate()
        process.communicate()


class RenderClient:
    """A client that calls by the names of rpcs: `client("get_version", wire.Empty())`."""

    def __init__(self, address: str):
        import grpc

        options = [("grpc.max_receive_message_length", MESSAGE_BYTES), ("grpc.max_send_message_length", MESSAGE_BYTES)]
        self._channel = grpc.insecure_channel(address, options)

    def __call__(self, name: str, message: Any) -> Any:
        """The reply of a call."""
        call = self._channel.unary_unary(f"/{SERVICE}/{name}")
        reply = call(message.SerializeToString(), timeout=DEADLINE_S, wait_for_ready=name == "get_version")
        return METHODS[name][1].FromString(reply)


@dataclass(frozen=True, eq=False)
class RigRequests:
    """Requests for the images of a rig in a scene, by what a server tells of it and its tracks."""

    scene_id: str
    spec: Any
    mounts: Sequence[np.ndarray]
    stamps: np.ndarray
    path: np.ndarray
    scene: Scene

    @classmethod
    def of(cls, client: RenderClient, scene_id: str, scene: Scene) -> "RigRequests":
        """Asks a server for cameras and path."""
        cameras = client("get_available_cameras", wire.AvailableCamerasRequest(scene_id=scene_id)).available_cameras
        trajectories = client("get_available_trajectories", wire.AvailableTrajectoriesRequest(scene_id=scene_id))
        poses = trajectories.available_trajectories[0].trajectory.poses
        turns = [rigid(Rotation.from_euler("z", yaw, degrees=True).as_matrix(), np.zeros(3)) for yaw in YAWS]
        spec = wire.CameraSpec.FromString(cameras[0].intrinsics.SerializeToString())
        spec.shutter_type = wire.ShutterType.ROLLING_TOP_TO_BOTTOM
        mounts = [turn @ _matrix(cameras[0].rig_to_camera) for turn in turns]
        path = np.stack([_matrix(own.pose) for own in poses])
        return cls(scene_id, spec, mounts, np.array([own.timestamp_us for own in poses]), path, scene)

    def batch(self, fraction: float, size: tuple[int, int], image_format: int, listed: Listed = "all") -> Any:
        """The request at a fraction of the recording, with images of a size and some of the objects."""
        first, last = int(self.stamps[0]), int(self.stamps[-1])
        start = first + round(fraction * (last - first - SHUTTER_US))
        ends = np.array([start, start + SHUTTER_US])
        rigs, objects = self._rigs(ends), [] if listed == "none" else self._objects(start)
        objects = objects[::2] if listed == "half" else objects
        reply = wire.BatchRGBRenderRequest()
        for number, mount in enumerate(self.mounts):
            pair = wire.PosePair(start_pose=pose_message(rigs[0] @ mount), end_pose=pose_message(rigs[1] @ mount))
            request = wire.RGBRenderRequest(
                scene_id=self.scene_id, resolution_w=size[0], resolution_h=size[1], camera_intrinsics=self.spec,
                frame_start_us=start, frame_end_us=start + SHUTTER_US, sensor_pose=pair, image_format=image_format,
                dynamic_objects=objects,
            )  # fmt: skip
            reply.items.add(camera_name=str(number), request=request)
        return reply

    def _rigs(self, stamps: np.ndarray) -> np.ndarray:
        """Poses (n, 4, 4) of the vehicle."""
        return PosePath(self.stamps, self.path).at(stamps)

    def _objects(self, start: int) -> list[Any]:
        """All tracks that are there, half a metre to their left."""
        found, aside = [], rigid(np.eye(3), np.array([0.0, 0.5, 0.0]))
        for track in self.scene.tracks:
            boxes = [box_at(track, stamp, self.scene.seconds(stamp)) for stamp in (start, start + SHUTTER_US)]
            if None not in boxes:
                start_pose, end_pose = (pose_message(box.object_to_world @ aside) for box in boxes if box is not None)
                pair = wire.PosePair(start_pose=start_pose, end_pose=end_pose)
                found.append(wire.DynamicObject(track_id=track.id, pose_pair=pair))
        return found


def _matrix(message: Any) -> np.ndarray:
    vec, quat = message.vec, message.quat
    turn = Rotation.from_quat([quat.w, quat.x, quat.y, quat.z], scalar_first=True).as_matrix()
    return rigid(turn, np.array([vec.x, vec.y, vec.z]))


def images_of(client: RenderClient, batch: Any) -> list[bytes]:
    """The images of a batch. Raises SystemExit with the first error, and where a camera is missing."""
    items = client("batch_render_rgb", batch).items
    if failed := [item.error_message for item in items if not item.success]:
        raise SystemExit(failed[0])
    if [item.camera_name for item in items] != [item.camera_name for item in batch.items]:
        raise SystemExit("the reply has other cameras than the request")
    return [item.result.image_bytes for item in items]
