"""Rendering rate of LiDAR scans: a synthetic street of Gaussians, seen by a LiDAR that spins while all of it moves.

    python -m benchmarks.scans                                    # two grids of rays, 1,000,000 Gaussians
    python -m benchmarks.scans --gaussians 20000 --rays 16x360    # a CPU, a quick look

Takes a GPU where there is one. Prints, for each grid, how many scans a second are rendered with and without motion, and
the milliseconds of a forward and backward pass: medians over rounds, after a warm-up.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.command import argument_parser, run_command
from drivesplat.machine.device import choose_device, device_name
from drivesplat.rasterization import RayGrid, ScanMotion, rasterize_scan
from drivesplat.settings.device import DeviceSettings

GRIDS = ((32, 1084), (64, 2650))
"""Beams and firings: the LiDARs of nuScenes and of Waymo."""
HEIGHT, REVOLUTION_S = 1.8, 0.1
BEAM_SPREAD = (1.5e-3, 1.5e-3)
ROUNDS = 5


class Street(NamedTuple):
    """n Gaussians on the ground and the facades of a street, up to 80 m from a LiDAR at the origin, and velocities. The
    fewer they are, the larger: they cover the same part of the rays."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    values: Tensor
    velocities: Tensor

    @classmethod
    def random(cls, count: int, device: torch.device, seed: int = 0) -> "Street":
        rng = np.random.default_rng(seed)
        azimuth = rng.uniform(-np.pi, np.pi, count)
        facade = rng.uniform(6.0, 12.0, count) / np.maximum(np.abs(np.sin(azimuth)), 0.05)
        reach = np.minimum(facade, 80.0)
        on_ground = rng.random(count) < 0.5
        distance = np.where(on_ground, reach * np.sqrt(rng.uniform(0.002, 1.0, count)), reach)
        z = np.where(on_ground, rng.normal(-HEIGHT, 0.02, count), rng.uniform(-HEIGHT, 8.0, count))
        scales = 4.0 / np.sqrt(count) * distance[:, None] * rng.uniform(0.2, 2.0, (count, 3))
        arrays = (
            np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), z]),
            rng.normal(size=(count, 4)),
            scales,
            rng.uniform(0.05, 0.95, count),
            rng.uniform(size=(count, 2)),
            np.tile([-8.0, 0.0, 0.0], (count, 1)),
        )
        return cls(*(torch.from_numpy(array).float().to(device) for array in arrays))


def measure(street: Street, beams: int, firings: int, scans: int) -> dict[str, float]:
    """Scans a second with and without motion, and the milliseconds of a forward and backward pass with it."""
    like = street.means
    azimuths = torch.linspace(-np.pi, np.pi, firings + 1)[:-1].expand(beams, firings)
    elevations = torch.deg2rad(torch.linspace(-25.0, 5.0, beams))[:, None].expand(beams, firings)
    offsets = torch.linspace(-REVOLUTION_S, 0.0, firings).expand(beams, firings)
    rays = RayGrid(*(values.to(like).contiguous() for values in (azimuths, elevations, offsets)))
    motion = ScanMotion(like.new_tensor([8.0, 0.0, 0.0]), like.new_tensor([0.0, 0.0, 0.1]), street.velocities)
    pose, inputs = torch.eye(4).to(like), street[:5]

    def forward(motion: ScanMotion | None) -> Tensor:
        return rasterize_scan(*inputs, pose, rays, beam_spread=BEAM_SPREAD, motion=motion).range

    def trained() -> None:
        leaves = [values.detach().requires_grad_() for values in inputs]
        rendering = rasterize_scan(*leaves, pose, rays, beam_spread=BEAM_SPREAD, motion=motion)
        (rendering.range.sum() + rendering.values.sum()).backward()

    with torch.no_grad():
        moving, still = (1.0 / seconds_of(lambda m=m: forward(m), scans, like.device) for m in (motion, None))
    return {
        "scans_per_second": moving,
        "scans_per_second_without_motion": still,
        "forward_and_backward_ms": 1e3 * seconds_of(trained, scans, like.device),
    }


def seconds_of(work: Callable[[], object], repetitions: int, device: torch.device) -> float:
    """The median over rounds of the mean time of one call, after a round that is not counted."""
    rounds = []
    for _ in range(ROUNDS + 1):
        began = time.perf_counter()
        for _ in range(repetitions):
            work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        rounds.append((time.perf_counter() - began) / repetitions)
    return float(np.median(rounds[1:]))


def grid(text: str) -> tuple[int, int]:
    """The numbers of beams and firings of a grid of rays, such as 32x1084."""
    beams, times, firings = text.partition("x")
    if not (times and beams.isdecimal() and firings.isdecimal() and int(beams) and int(firings)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of beams and of firings, such as 32x1084")
    return int(beams), int(firings)


def main(arguments: Sequence[str]) -> int:
    """Runs the command with these arguments; returns its exit status."""
    parser = argument_parser("scans", __doc__)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--rays", nargs="+", type=grid, default=GRIDS, metavar="BEAMSxFIRINGS")
    parser.add_argument("--scans", type=int, default=60, help="scans in a round")
    options = parser.parse_args(arguments)
    device = choose_device(DeviceSettings(kind="any"))
    street = Street.random(options.gaussians, device)
    found = {"device": device_name(device), "gaussians": options.gaussians}
    for beams, firings in options.rays:
        found[f"{beams}x{firings}"] = measure(street, beams, firings, options.scans)
    print(json.dumps(found, indent=2))
    return 0


if __name__ == "__main__":
    run_command(main)
