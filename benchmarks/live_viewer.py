"""Images a second of the live viewer while a drive is played, as a window of a process of its own receives them.

    python -m benchmarks.live_viewer results/demo/street --size 1280x720 --seconds 10

The window follows the first camera of the drive, and decodes every image. It needs viser, and no browser.
"""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import cv2
import numpy as np

from benchmarks.command import argument_parser
from benchmarks.sensor_service import image_size
from drivesplat.drive.live_server import LiveServer
from drivesplat.drive.trained_drive import open_drive

IMAGE = "BackgroundImageMessage"
PORT = 8907
WARM_UP_S = 3.0
"""Seconds whose images are not counted: programs are compiled, CUDA graphs captured."""


def window(url: str, width: int, height: int, seconds: float) -> str:
    """Opens a window of viser and receives images for so many seconds; returns the figures."""
    import msgspec
    import viser
    from websockets.sync.client import connect

    camera = {
        "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 0.0), "fov": 1.0,
        "near": 0.1, "far": 100.0, "image_height": height, "image_width": width, "look_at": (0.0, 0.0, 1.0),
        "up_direction": (0.0, 0.0, 1.0),
    }  # fmt: skip
    arrived, sizes = [], set()
    with connect(url, subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as connection:
        connection.send(msgspec.msgpack.encode(camera))
        began = monotonic()
        while monotonic() - began < WARM_UP_S + seconds:
            for jpeg in _images(connection.recv(timeout=60.0)):
                image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
                if monotonic() - began > WARM_UP_S:
                    arrived.append(monotonic())
                    sizes.add(f"{image.shape[1]}x{image.shape[0]}")
    between = 1e3 * np.diff(arrived)
    return (
        f"{len(between) / (arrived[-1] - arrived[0]):.1f} images/s of {', '.join(sorted(sizes))}; between two images "
        f"{np.median(between):.0f} ms (median), {np.quantile(between, 0.95):.0f} ms (95 %)"
    )


def _images(packet: Any) -> Iterator[bytes]:
    """The background images of a packet of viser: its sizes, its messages, and what is too large for them."""
    import msgspec
    import zstandard

    packed = int.from_bytes(packet[8:16], "little")
    content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packet[16 : 16 + packed]))
    for message in content["messages"]:
        if message["type"] == IMAGE and message["rgb_data"] is not None:
            yield message["rgb_data"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures. Returns the exit status."""
    parser = argument_parser("live_viewer", __doc__)
    parser.add_argument("path", help="folder of a method, or the address of a viewer that runs")
    parser.add_argument("--size", type=image_size, default=(1280, 720), metavar="WxH", help="of the window (1280x720)")
    parser.add_argument("--seconds", type=float, default=10.0, help="seconds that are counted (10)")
    parser.add_argument("--device", choices=["any", "cuda", "cpu"], default="any")
    parsed = parser.parse_args(arguments)
    width, height = parsed.size
    if parsed.path.startswith("ws:"):
        print(window(parsed.path, width, height, parsed.seconds))
        return 0
    server = LiveServer([open_drive(Path(parsed.path), parsed.device)], port=PORT)
    command = [sys.executable, "-m", "benchmarks.live_viewer", server.url.replace("http:", "ws:")]
    command += ["--size", f"{width}x{height}", "--seconds", str(parsed.seconds)]
    with subprocess.Popen(command) as client:
        server.controls.changing(lambda: setattr(server.controls.play, "value", True))
        while client.poll() is None:
            sleep(0.1)
    server.close()
    return client.returncode


if __name__ == "__main__":
    sys.exit(main())
