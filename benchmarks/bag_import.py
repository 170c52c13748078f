"""Time and memory of `drivesplat import bag`, on a bag of ROS 2 that is written for it.

    python -m benchmarks.bag_import --seconds 60 --cameras 6

The bag is an MCAP file in a temporary folder: JPEGs of 1600x900 pixels from each camera and sweeps of a LiDAR with
100,000 points, each at 10 Hz, and the vehicle's pose in tf at 50 Hz. Images are seeded noise, smooth over ten pixels.
The import is the two commands of docs/own_data.md, each in a process of its own: a line has wall seconds, processor
seconds and the peak of resident memory. On a machine that other work shares, wall seconds grow with its load.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from heapq import merge
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.command import argument_parser, run_command
from drivesplat.errors import RequestError
from drivesplat.export.mcap_file import mcap_file
from drivesplat.export.ros_messages import BASE, MAP, camera_info, jpeg_image, point_cloud, transforms
from drivesplat.scene.rigid import rigid
from drivesplat.scene.sensors import Camera

WIDTH, HEIGHT = 1600, 900
START = 1_700_000_000_000_000
"""Microseconds."""
EVERY, POSES_EVERY = 100_000, 20_000
"""Microseconds between two recordings of a sensor, and between two poses."""
BEAMS, FIRINGS = 64, 1563
IMAGES = 12
"""Different images; a camera shows them one after the other."""
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""A camera that looks ahead: x right, y down, z forward."""
INTRINSICS = np.array([[1266.4, 0.0, 816.3], [0.0, 1266.4, 491.5], [0.0, 0.0, 1.0]])

Stamped = tuple[int, str, Any]
"""The stamp of a message (microseconds), its topic, and the message."""


def jpegs(rng: np.random.Generator) -> list[bytes]:
    """Different images as JPEG files."""
    found = []
    for _ in range(IMAGES):
        coarse = rng.integers(0, 256, (HEIGHT // 10, WIDTH // 10, 3), dtype=np.uint8)
        pixels = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        found.append(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    return found


def images(cameras: int, seconds: int, files: Sequence[bytes]) -> Iterator[Stamped]:
    """The images of all cameras, and their calibration."""
    lens = Camera("camera", WIDTH, HEIGHT, INTRINSICS)
    for number in range(seconds * 10):
        for camera in range(cameras):
            stamp, frame = START + number * EVERY + 3000 * camera, f"camera{camera}_optical"
            data = files[(number + camera) % len(files)]
            yield stamp, f"/camera{camera}/image_raw/compressed", jpeg_image(stamp, frame, data)
            yield stamp, f"/camera{camera}/camera_info", camera_info(stamp, frame, lens)


def sweeps(seconds: int, rng: np.random.Generator) -> Iterator[Stamped]:
    """The sweeps of a LiDAR that spins, each with other distances."""
    azimuths, elevations = np.meshgrid(np.linspace(0, 2 * np.pi, FIRINGS), np.radians(np.linspace(-20, 10, BEAMS)))
    level = np.cos(elevations)
    rays = np.stack([level * np.cos(azimuths), level * np.sin(azimuths), np.sin(elevations)], axis=-1).reshape(-1, 3)
    after = np.tile(np.linspace(0, 99e6, FIRINGS), BEAMS).astype(np.uint32)
    rings = np.repeat(np.arange(BEAMS, dtype=np.uint16), FIRINGS)
    for stamp in range(START, START + seconds * 10**6, EVERY):
        points = (rays * rng.uniform(4, 80, (len(rays), 1))).astype(np.float32)
        bright = rng.integers(0, 256, len(rays)).astype(np.float32)
        yield stamp, "/top/points", point_cloud(stamp, "top", points, bright, rings, after)


def poses(seconds: int) -> Iterator[Stamped]:
    """The vehicle in a curve of 40 m at 8 m/s, from before the first to after the last recording."""
    for stamp in range(START - EVERY, START + seconds * 10**6 + 2 * EVERY, POSES_EVERY):
        angle = 0.2e-6 * (stamp - START)
        place = np.array([40 * np.sin(angle), 40 * (1 - np.cos(angle)), 0.0])
        pose = rigid(Rotation.from_euler("z", angle).as_matrix(), place)
        yield stamp, "/tf", transforms(stamp, MAP, {BASE: pose})


def write_bag(path: Path, cameras: int, seconds: int, seed: int = 0) -> None:
    """Writes the bag. Raises RequestError where rosbags is missing."""
    rng = np.random.default_rng(seed)
    mounts = {"top": rigid(np.eye(3), np.array([0.9, 0.0, 1.8]))}
    for camera in range(cameras):
        turn = Rotation.from_euler("z", 2 * np.pi * camera / cameras).as_matrix()
        mounts[f"camera{camera}_optical"] = rigid(turn @ OPTICAL, np.array([1.0, 0.0, 1.5]))
    recorded = (images(cameras, seconds, jpegs(rng)), sweeps(seconds, rng), poses(seconds))
    with mcap_file(path, {}) as bag:
        bag.write("/tf_static", START - EVERY, transforms(START - EVERY, BASE, mounts))
        for stamp, topic, message in merge(*recorded, key=lambda entry: entry[0]):
            bag.write(topic, stamp, message)


def measured(arguments: Sequence[str]) -> tuple[float, float, float]:
    """Wall seconds, processor seconds and peak of memory (GB) of a command of drivesplat. Raises RequestError where it
    fails."""
    began = perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "drivesplat.cli", *arguments], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RequestError(f"drivesplat {' '.join(arguments)} ended with status {process.returncode}")
    return perf_counter() - began, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024e-9


def main(arguments: Sequence[str]) -> int:
    """Measures. Returns the exit status."""
    parser = argument_parser("bag_import", __doc__)
    parser.add_argument("--seconds", type=int, default=60, help="length of the bag (60)")
    parser.add_argument("--cameras", type=int, default=6, help="number of cameras (6)")
    parser.add_argument("--folder", type=Path, help="where the temporary folder goes; by default as Python chooses")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        bag, topics, drive = (str(Path(name, file)) for file in ("bag.mcap", "topics.yaml", "drive"))
        write_bag(Path(bag), given.cameras, given.seconds)
        print(
            f"{given.seconds} s of {given.cameras} cameras and a LiDAR: {Path(bag).stat().st_size * 1e-9:.2f} GB",
            flush=True,
        )
        commands = {
            "propose": ["import", "bag", bag, "--propose", topics],
            "import": ["import", "bag", bag, "--map", topics, "--out", drive],
        }
        for what, command in commands.items():
            wall, processor, memory = measured(command)
            print(f"{what}: {wall:.1f} s, {processor:.1f} s of processors, {memory:.2f} GB at most", flush=True)
        count = sum(1 for file in Path(drive).rglob("*") if file.is_file())
        print(f"{count} files in the drive folder")
    return 0


if __name__ == "__main__":
    run_command(main)
