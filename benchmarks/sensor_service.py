"""Rigs a second of the sensor service: a server in a process of its own, and a client as AlpaSim's runtime is one.

    python -m benchmarks.sensor_service results/demo/street --size 1920x1080 --frames 300
    python -m benchmarks.sensor_service results/demo/street --size 160x90 --simulate --frames 600 --rollouts 4
    python -m benchmarks.sensor_service results/demo/street --size 48x27 --soak 20000 --log soak.csv
    python -m benchmarks.sensor_service results/demo/street --size 48x27 --offered 10 --frames 40

A rig has three cameras, which look ahead and to both sides with the intrinsics of the scene's first camera. A call asks
for the images of all of them at one time, with rolling shutters of 17 ms and all tracks of the scene as moving objects.
Each rollout has one call in progress. The share inside of the model is the part of the time in which a model was in
use. Memory is that of the server: before the first counted call, the range while they run, and at the end. No two calls
ask for the same time.

With --simulate, each rollout first asks for version, scenes, cameras and ego masks, and then goes round the recording,
from a time of its own on: the first one with all objects, the second one with every second object, the third one
without any, and so on. Every image must come, and every tenth frame that is asked for alone afterwards must have equal
bytes. Meanwhile get_version is called all the time.

With --soak, requests of all served scenes come in random order; equal requests must get equal bytes. Memory and open
files of the server are those after every request was answered once, and later. --log writes them into a table.

With --offered, servers offer the first drive under two and under so many names, and load two of them at a time. Memory
is that at the start, after frames of two scenes, and after two rounds of all scenes.
"""

import hashlib
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import cv2
import numpy as np

from benchmarks.command import argument_parser
from benchmarks.sensor_client import (
    FORMATS,
    LISTED,
    YAWS,
    Listed,
    RenderClient,
    RigRequests,
    RunningServer,
    images_of,
    running_server,
)
from drivesplat.io.storage import write_csv
from drivesplat.scene.scene import read_scene
from drivesplat.serve.messages import wire
from drivesplat.serve.scenes import DriveSource, find_sources

WATCH_S = 5.0
"""Seconds between two samples of a server's memory."""
LOGGED = ("seconds", "memory_mb", "open_files")
"""The columns of a log of a server's memory."""


class Watch:
    """Samples of a server's memory and open files, with the seconds since it was made. `log` gets them as a table."""

    def __init__(self, server: RunningServer, log: Path | None = None):
        self._server, self._log, self._began = server, log, perf_counter()
        self.samples: list[tuple[float, float, int]] = []
        self.look()

    def look(self) -> None:
        """Adds a sample."""
        seconds = perf_counter() - self._began
        self.samples.append((seconds, self._server.memory_mb(), self._server.open_files()))
        if self._log is not None:
            write_csv(self._log, LOGGED, [dict(zip(LOGGED, sample, strict=True)) for sample in self.samples])

    def __str__(self) -> str:
        _, memory, files = np.array(self.samples).T
        return (
            f"memory {memory[0]:.0f} MB, then {memory.min():.0f} to {memory.max():.0f}, {memory[-1]:.0f} MB at the end"
            f"; open files {files[0]:.0f}, then {files.min():.0f} to {files.max():.0f}"
        )


BLACK = 10
"""The largest value of an image that AlpaSim counts as black."""
VERSION_S = 0.1
"""Seconds between two calls of get_version."""
CHECK_EVERY = 10
"""Of so many frames of rollouts one is rendered again."""


def speed(
    server: RunningServer, batches: Sequence[Any], rollouts: int, warm_up: int, log: Path | None = None
) -> str:  # fmt: skip
    """Sends batches, `rollouts` at a time, after some that are not counted; returns the figures. `log` gets a table of
    memory and open files."""
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

    watch, before, began = Watch(server, log), server.model_seconds(), perf_counter()
    with repeated(watch.look, WATCH_S), ThreadPoolExecutor(rollouts) as threads:
        calls = [call for own in threads.map(roll_out, range(rollouts)) for call in own]
        seconds, inside = perf_counter() - began, server.model_seconds() - before
    watch.look()
    latencies = np.array([latency for latency, _ in calls])
    images = len(calls) * len(YAWS)
    return (
        f"{len(calls)} rigs, {rollouts} at a time: {len(calls) / seconds:.2f} rigs/s, {images / seconds:.2f} images/s; "
        f"latency {1e3 * np.median(latencies):.0f} ms (median), {1e3 * np.quantile(latencies, 0.95):.0f} ms (95 %); "
        f"inside of the model {100 * inside / seconds:.0f} % of the time; "
        f"{np.mean([size for _, size in calls]) / 1000:.0f} kB a rig; {watch}"
    )


Batches = Callable[..., Any]
"""What makes the request of a rig at a fraction of its recording: `RigRequests.batch` of a size and a format."""


class RolloutFrame(NamedTuple):
    """A frame of a rollout, which has a number."""

    rollout: int
    rig: RigRequests
    fraction: float
    listed: Listed

    def images(self, client: RenderClient, batch: Batches) -> list[bytes]:
        """What a server shows."""
        return images_of(client, batch(self.rig, self.fraction, listed=self.listed))


def simulate(server: RunningServer, rigs: Sequence[RigRequests], batch: Batches, frames: int, rollouts: int) -> str:
    """Has `rollouts` at a time, of `frames` in all; returns the figures. Raises SystemExit for an image that is
    missing, or that differs from that of the same request alone."""
    each, found = max(1, frames // rollouts), {}
    asked = []
    for n in range(rollouts):
        rig, listed, first = rigs[n % len(rigs)], LISTED[n % len(LISTED)], n * each // rollouts
        asked.append([RolloutFrame(n, rig, (first + i) % each / each, listed) for i in range(each)])

    def roll_out(own: Sequence[RolloutFrame]) -> list[float]:
        client, seconds = RenderClient(server.address), []
        _prepare(client, own[0].rig.scene_id)
        for frame in own:
            began = perf_counter()
            found[frame] = frame.images(client, batch)
            seconds.append(perf_counter() - began)
        return seconds

    ask_version, began = partial(RenderClient(server.address), "get_version", wire.Empty()), perf_counter()
    with repeated(ask_version, VERSION_S) as versions, ThreadPoolExecutor(rollouts) as threads:
        latencies = np.concatenate([*threads.map(roll_out, asked)])
    seconds, alone = perf_counter() - began, RenderClient(server.address)
    checked = [frame for own in asked for frame in own[::CHECK_EVERY]]
    wrong = sum(frame.images(alone, batch) != found[frame] for frame in checked)
    black = sum(_is_black(image) for images in found.values() for image in images)
    text = (
        f"{len(latencies)} frames of {len(YAWS)} images in {rollouts} rollouts: {len(latencies) / seconds:.2f} rigs/s; "
        f"latency {_milliseconds(latencies)}; {black} black images; {_changed(found)}; {wrong} of {len(checked)} "
        f"frames differ when they are asked for alone; get_version {_milliseconds(np.array(versions))} in "
        f"{len(versions)} calls"
    )
    if wrong:
        raise SystemExit(text)
    return text


def _prepare(client: RenderClient, scene_id: str) -> None:
    """What a runtime asks for before the first frame."""
    client("get_version", wire.Empty())
    if scene_id not in client("get_available_scenes", wire.Empty()).scene_ids:
        raise SystemExit(f"{scene_id} is not served")
    client("get_available_cameras", wire.AvailableCamerasRequest(scene_id=scene_id))
    client("get_available_ego_masks", wire.Empty())


def _milliseconds(seconds: np.ndarray) -> str:
    median, most = 1e3 * np.quantile(seconds, [0.5, 0.95])
    return f"{median:.0f} ms (median), {most:.0f} ms (95 %), {1e3 * seconds.max():.0f} ms (longest)"


def _is_black(image: bytes) -> bool:
    return int(cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR).max()) <= BLACK


def _changed(found: Mapping[RolloutFrame, list[bytes]]) -> str:
    """How many frames show something else where objects are left out."""
    shown = {frame[1:]: images for frame, images in found.items()}
    counts = []
    for less in LISTED[1:]:
        both = [place for *place, listed in shown if listed == "all" and (*place, less) in shown]
        other = sum(shown[*place, "all"] != shown[*place, less] for place in both)
        counts.append(f"{other} of {len(both)} frames change with {less} of the objects")
    return ", ".join(counts)


@contextmanager
def repeated(call: Callable[[], Any], pause_s: float) -> Iterator[list[float]]:
    """Calls again and again until the block ends, at least once; the seconds that each call took are added to the
    list."""
    ended, seconds = threading.Event(), []

    def go_on() -> None:
        while not (seconds and ended.wait(pause_s)):
            began = perf_counter()
            call()
            seconds.append(perf_counter() - began)

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield seconds
    finally:
        ended.set()
        thread.join()


def soak(
    server: RunningServer, batches: Sequence[Any], count: int, rollouts: int, log: Path | None = None, seed: int = 0
) -> str:  # fmt: skip
    """Sends `count` single requests in random order; returns the figures. `log` gets a table of memory and open files.
    Raises SystemExit for an image that differs from that of an equal request before."""
    requests = [item.request for batch in batches for item in batch.items]
    clients = [RenderClient(server.address) for _ in range(rollouts)]

    def digest(client: RenderClient, number: int) -> str:
        return hashlib.sha256(client("render_rgb", requests[number]).image_bytes).hexdigest()

    known = [digest(clients[0], number) for number in range(len(requests))]
    order = np.random.default_rng(seed).integers(0, len(requests), count)

    def roll_out(number: int) -> int:
        return sum(digest(clients[number], i) != known[i] for i in order[number::rollouts].tolist())

    watch = Watch(server, log)
    with repeated(watch.look, WATCH_S), ThreadPoolExecutor(rollouts) as threads:
        wrong = sum(threads.map(roll_out, range(rollouts)))
    watch.look()
    text = (
        f"{count} requests of {len(requests)} kinds in random order, {rollouts} at a time: "
        f"{count / watch.samples[-1][0]:.1f} a second, {wrong} wrong images; {watch}"
    )
    if wrong:
        raise SystemExit(text)
    return text


def copies(source: DriveSource, folder: Path, count: int) -> list[Path]:
    """Methods of `count` scenes in `folder` that are all the drive of `source`: their files are links."""
    method, found = source.folder.resolve(), []
    for number in range(count):
        copy = folder / f"{source.scene}_{number}" / source.method
        copy.mkdir(parents=True)
        for file in (*method.parent.iterdir(), *method.iterdir()):
            if file.is_file():
                (copy.parent / file.relative_to(method.parent)).symlink_to(file)
        found.append(copy)
    return found


def memory(methods: Sequence[Path], device: str, batch: Batches, frames: int) -> str:
    """A server offers drives and loads two of them at a time; returns its memory."""
    sources, used = find_sources(methods), 2
    with running_server(methods, device, ["--max-loaded", str(used)]) as server:
        client, at_first = RenderClient(server.address), server.memory_mb()
        names = [*sources]
        rigs = [_rig(client, name, sources[name]) for name in names[:used]]
        for i in range(frames):
            images_of(client, batch(rigs[i % used], i / frames))
        after = server.memory_mb()
        rigs += [_rig(client, name, sources[name]) for name in names[used:]]
        for rig in (*rigs, *rigs):
            images_of(client, batch(rig, 0.5))
        rounds = server.memory_mb()
    return (
        f"{len(rigs)} scenes offered: {at_first:.0f} MB at the start, {after:.0f} MB after {frames} rigs of {used} "
        f"scenes, {rounds:.0f} MB after two rounds of all scenes"
    )


def _rig(client: RenderClient, name: str, source: DriveSource) -> RigRequests:
    return RigRequests.of(client, name, read_scene(source.folder.resolve().parent / "scene.json"))


def image_size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return int(width), int(height)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures. Returns the exit status."""
    parser = argument_parser("sensor_service", __doc__)
    parser.add_argument("paths", type=Path, nargs="+", help="folders as of drivesplat serve")
    parser.add_argument("--size", type=image_size, default=(1920, 1080), metavar="WxH", help="of images (1920x1080)")
    parser.add_argument("--frames", type=int, default=300, help="number of calls (300)")
    parser.add_argument("--rollouts", type=int, default=1, help="calls in progress at a time (1)")
    parser.add_argument("--format", choices=FORMATS, default="jpeg")
    parser.add_argument("--device", choices=["any", "cuda", "cpu"], default="any")
    parser.add_argument("--jpeg", choices=["threads", "device"], default="threads", help="as of drivesplat serve")
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--simulate", action="store_true", help="roll out as a simulator does, and check the images")
    kinds.add_argument("--soak", type=int, metavar="N", help="send N requests in random order instead")
    kinds.add_argument("--offered", type=int, metavar="N", help="memory of servers that offer 2 and N scenes instead")
    parser.add_argument("--kinds", type=int, default=60, metavar="N", help="with --soak: different requests (60)")
    parser.add_argument(
        "--log",
        type=Path,
        metavar="CSV",
        help="table of memory and open files over time, not with --simulate and --offered",
    )
    parsed = parser.parse_args(arguments)
    sources = find_sources(parsed.paths)
    batch = partial(RigRequests.batch, size=parsed.size, image_format=FORMATS[parsed.format])
    if parsed.offered is not None:
        with tempfile.TemporaryDirectory() as folder:
            methods = copies(next(iter(sources.values())), Path(folder), max(2, parsed.offered))
            for some in (methods[:2], methods):
                print(memory(some, parsed.device, batch, parsed.frames), flush=True)
        return 0
    options = ["--jpeg", parsed.jpeg, "--max-loaded", str(len(sources))]
    with running_server(parsed.paths, parsed.device, options) as server:
        client = RenderClient(server.address)
        rigs = [_rig(client, name, source) for name, source in sources.items()]
        if parsed.soak is not None:
            each = -(-parsed.kinds // (len(rigs) * len(YAWS)))
            batches = [batch(rig, i / each) for rig in rigs for i in range(each)]
            print(soak(server, batches, parsed.soak, max(2, parsed.rollouts), parsed.log))
        elif parsed.simulate:
            print(simulate(server, rigs, batch, parsed.frames, parsed.rollouts))
        else:
            batches = [batch(rigs[i % len(rigs)], i / parsed.frames) for i in range(parsed.frames)]
            print(speed(server, batches, parsed.rollouts, min(5, len(batches)), parsed.log))
    return 0


if __name__ == "__main__":
    sys.exit(main())
