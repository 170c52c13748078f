"""Rigs a second of the sensor service: a server in a process of its own, and a client as AlpaSim's runtime is one.

    python -m benchmarks.sensor_service results/demo/street --size 1920x1080 --frames 300
    python -m benchmarks.sensor_service results/demo --size 48x27 --soak 20000

A rig has three cameras, which look ahead and to both sides with the intrinsics of the scene's first camera. A call asks
for the images of all of them at one time, with rolling shutters of 17 ms and all tracks of the scene as moving objects.
Each rollout has one call in progress. The share inside of the model is the part of the time in which the device was in
use.

With --soak, requests of all served scenes come in random order; equal requests must get equal bytes. Memory and open
files of the server are those after every request was answered once, and at the end.
"""

import hashlib
import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.command import argument_parser
from drivesplat.scene.pose_path import PosePath
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene, read_scene
from drivesplat.scene.tracks import box_at
from drivesplat.serve.messages import METHODS, SERVICE, wire
from drivesplat.serve.poses import pose_message
from drivesplat.serve.scenes import find_sources

SHUTTER_US = 17_000
YAWS = (0.0, 55.0, -55.0)
"""Directions of the cameras in degrees to the left."""
MESSAGE_BYTES = 64 << 20
FORMATS = {"jpeg": wire.ImageFormat.JPEG, "png": wire.ImageFormat.PNG}
DISTINCT = 60
"""Different requests of a soak."""


@dataclass(frozen=True)
class RunningServer:
    """A server in a process of its own."""

    pid: int
    address: str
    metrics: str

    def model_seconds(self) -> float:
        """Seconds in which the device was in use."""
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
        return METHODS[name][1].FromString(call(message.SerializeToString()))


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

    def batch(self, fraction: float, size: tuple[int, int], image_format: int) -> Any:
        """The request at a fraction of the recording, with images of a size."""
        first, last = int(self.stamps[0]), int(self.stamps[-1])
        start = first + round(fraction * (last - first - SHUTTER_US))
        ends = np.array([start, start + SHUTTER_US])
        rigs, objects = self._rigs(ends), self._objects(start)
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
    """The images of a batch. Raises SystemExit with the first error."""
    items = client("batch_render_rgb", batch).items
    if failed := [item.error_message for item in items if not item.success]:
        raise SystemExit(failed[0])
    return [item.result.image_bytes for item in items]


def speed(server: RunningServer, batches: Sequence[Any], rollouts: int, warm_up: int) -> str:
    """Sends batches, `rollouts` at a time, after some that are not counted; returns the figures."""
    clients = [RenderClient(server.address) for _ in range(rollouts)]
    for batch in batches[:warm_up]:
        images_of(clients[0], batch)

    def roll_out(number: int) -> list[tuple[float, int]]:
        found = []
        for batch in batches[number::rollouts]:
            began = perf_counter()
            size = sum(map(len, images_of(clients[number], batch)))
            found.append((perf_counter() - began, size))
        return found

    before, began = server.model_seconds(), perf_counter()
    with ThreadPoolExecutor(rollouts) as threads:
        calls = [call for own in threads.map(roll_out, range(rollouts)) for call in own]
    seconds, inside = perf_counter() - began, server.model_seconds() - before
    latencies = np.array([latency for latency, _ in calls])
    images = len(calls) * len(YAWS)
    return (
        f"{len(calls)} rigs, {rollouts} at a time: {len(calls) / seconds:.2f} rigs/s, {images / seconds:.2f} images/s; "
        f"latency {1e3 * np.median(latencies):.0f} ms (median), {1e3 * np.quantile(latencies, 0.95):.0f} ms (95 %); "
        f"inside of the model {100 * inside / seconds:.0f} % of the time; "
        f"{np.mean([size for _, size in calls]) / 1000:.0f} kB a rig"
    )


def soak(server: RunningServer, batches: Sequence[Any], count: int, rollouts: int, seed: int = 0) -> str:
    """Sends `count` single requests in random order; returns the figures. Raises SystemExit for an image that differs
    from that of an equal request before."""
    requests = [item.request for batch in batches for item in batch.items]
    clients = [RenderClient(server.address) for _ in range(rollouts)]

    def digest(client: RenderClient, number: int) -> str:
        return hashlib.sha256(client("render_rgb", requests[number]).image_bytes).hexdigest()

    known = [digest(clients[0], number) for number in range(len(requests))]
    before, order = (
        (server.memory_mb(), server.open_files()),
        np.random.default_rng(seed).integers(0, len(requests), count),
    )

    def roll_out(number: int) -> int:
        return sum(digest(clients[number], i) != known[i] for i in order[number::rollouts].tolist())

    began = perf_counter()
    with ThreadPoolExecutor(rollouts) as threads:
        wrong = sum(threads.map(roll_out, range(rollouts)))
    seconds, after = perf_counter() - began, (server.memory_mb(), server.open_files())
    text = (
        f"{count} requests of {len(requests)} kinds in random order, {rollouts} at a time: {count / seconds:.1f} a "
        f"second, {wrong} wrong images; memory {before[0]:.0f} MB, then {after[0]:.0f} MB; open files {before[1]}, "
        f"then {after[1]}"
    )
    if wrong:
        raise SystemExit(text)
    return text


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return int(width), int(height)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures. Returns the exit status."""
    parser = argument_parser("sensor_service", __doc__)
    parser.add_argument("paths", type=Path, nargs="+", help="folders as of drivesplat serve")
    parser.add_argument("--size", type=_size, default=(1920, 1080), metavar="WxH", help="of images (1920x1080)")
    parser.add_argument("--frames", type=int, default=300, help="number of calls (300)")
    parser.add_argument("--rollouts", type=int, default=1, help="calls in progress at a time (1)")
    parser.add_argument("--format", choices=FORMATS, default="jpeg")
    parser.add_argument("--device", choices=["any", "cuda", "cpu"], default="any")
    parser.add_argument("--jpeg", choices=["threads", "device"], default="threads", help="as of drivesplat serve")
    parser.add_argument("--soak", type=int, metavar="N", help="send N requests in random order instead")
    parsed = parser.parse_args(arguments)
    sources = find_sources(parsed.paths)
    options = ["--jpeg", parsed.jpeg, "--max-loaded", str(len(sources))]
    with running_server(parsed.paths, parsed.device, options) as server:
        client, rigs = RenderClient(server.address), []
        for name, source in sources.items():
            scene = read_scene(source.folder.resolve().parent / "scene.json")
            rigs.append(RigRequests.of(client, name, scene))
        batch = partial(RigRequests.batch, size=parsed.size, image_format=FORMATS[parsed.format])
        if parsed.soak is not None:
            each = -(-DISTINCT // (len(rigs) * len(YAWS)))
            batches = [batch(rig, i / each) for rig in rigs for i in range(each)]
            print(soak(server, batches, parsed.soak, max(2, parsed.rollouts)))
            return 0
        batches = [batch(rigs[i % len(rigs)], i / parsed.frames) for i in range(parsed.frames)]
        print(speed(server, batches, parsed.rollouts, warm_up=min(5, len(batches))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
