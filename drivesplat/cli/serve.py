"""The command `drivesplat serve`: trained drives as the renderer of a simulator.

drivesplat serve results/ --address 127.0.0.1:50051
"""

import argparse
import signal
import threading
from pathlib import Path
from typing import Any

import drivesplat
from drivesplat.errors import RequestError

COMMAND = "serve"
LOOK_EVERY_S = 0.5
"""Seconds between two looks for the end. A signal that reaches another thread does not wake the one that waits."""


def add_parser(commands: Any) -> None:
    """Adds the command to the sub-parsers of `drivesplat`."""
    parser = commands.add_parser(
        COMMAND, help="serve trained drives as the renderer of AlpaSim, over gRPC (docs/simulators.md)"
    )
    parser.add_argument(
        "paths",
        type=Path,
        nargs="+",
        metavar="PATH",
        help="folder of results, a scene or a method, or scene.alpasim.usdz",
    )
    parser.add_argument("--address", default="127.0.0.1:50051", help="host and port to listen at (127.0.0.1:50051)")
    parser.add_argument("--device", default="any", choices=["any", "cuda", "cpu"], help="any: a GPU where there is one")
    parser.add_argument(
        "--max-loaded", type=int, default=2, metavar="N", help="number of scenes in memory at a time (2)"
    )
    parser.add_argument(
        "--max-calls", type=int, default=64, metavar="N",
        help="number of calls in progress at a time; further ones are refused at once (64)",
    )  # fmt: skip
    parser.add_argument(
        "--unlisted", default="removed", choices=["removed", "recorded"],
        help="what a request without any dynamic object shows of those that it could list (removed)",
    )  # fmt: skip
    parser.add_argument(
        "--jpeg", default="threads", choices=["threads", "device"],
        help="encode JPEGs in threads by OpenCV, or on the device by torchvision (threads)",
    )  # fmt: skip
    parser.add_argument("--metrics-port", type=int, metavar="PORT", help="serve figures for Prometheus on this machine")
    parser.add_argument("--tls-cert", type=Path, metavar="PEM", help="certificate, for encrypted connections")
    parser.add_argument("--tls-key", type=Path, metavar="PEM", help="its private key")


def run_serve(parsed: argparse.Namespace) -> int:
    """Serves until SIGINT or SIGTERM, and then ends when all calls have been answered. Returns the exit status."""
    if (parsed.tls_cert is None) != (parsed.tls_key is None):
        raise RequestError("--tls-cert and --tls-key belong together: give both, or neither")
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    server = drivesplat.SensorServer(
        parsed.paths, parsed.address, device=parsed.device, max_loaded=parsed.max_loaded,
        max_calls=parsed.max_calls, unlisted=parsed.unlisted, jpeg=parsed.jpeg, metrics_port=parsed.metrics_port,
        tls=None if parsed.tls_cert is None else (parsed.tls_cert, parsed.tls_key),
    )  # fmt: skip
    if server.device.type == "cpu":
        print("drivesplat serve: images are rendered on the CPU, which is slow: a few small ones a second")
    if server.metrics_address is not None:
        print(f"drivesplat serve: figures at {server.metrics_address}")
    print(f"drivesplat serve: {server.address} serves {', '.join(server.scenes)}; Ctrl-C ends it", flush=True)
    while not ended.wait(LOOK_EVERY_S):
        pass
    print("drivesplat serve: ending when all calls have been answered", flush=True)
    server.close()
    return 0
