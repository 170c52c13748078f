"""The command `drivesplat estimate`: what a long recording would take, by blocks that have been measured.

drivesplat estimate --hours 1 --cameras 6 --size 1600x900 --hz 10 --speed-kmh 40 --cards 1,8,64
"""

import argparse
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from drivesplat.workflow.costs.block_costs import (
    BlockCosts,
    PaperEstimate,
    PaperRecording,
    chosen_costs,
    measured_drives,
    on_paper,
)
from drivesplat.workflow.costs.estimate import spelled

COMMAND = "estimate"


def add_parser(commands: Any) -> None:
    """Adds the command to the sub-parsers of `drivesplat`."""
    text = "estimate what a long recording takes, by blocks that have been measured (docs/costs.md)"
    parser = commands.add_parser(COMMAND, help=text)
    parser.add_argument("--hours", type=_above_zero(float), required=True, help="length of the recording")
    parser.add_argument("--cameras", type=_above_zero(int), default=1, help="number of cameras to train on (1)")
    parser.add_argument("--size", type=_size, help="of training images, such as 1600x900; by default as measured")
    parser.add_argument("--hz", type=_above_zero(float), required=True, help="images a second of each camera")
    parser.add_argument("--speed-kmh", type=_above_zero(float), required=True, help="mean speed while driving")
    parser.add_argument("--cards", type=_numbers, default=[1, 8, 64], help="numbers of GPUs (1,8,64)")
    parser.add_argument("--per-card", type=_above_zero(int), help="trainings at a time on a GPU (device.jobs_per_card)")
    parser.add_argument("--drive", help="whose blocks are taken; by default the one with most measured blocks")
    parser.add_argument("--method", help="by default each that its blocks were trained with")
    parser.add_argument("--results", type=Path, help="folder of the results (results_dir of config.yaml)")


def run_estimate(parsed: argparse.Namespace, results: Path, per_card: int) -> int:
    """Prints the estimate by the blocks in a results folder; `per_card` trainings at a time on a GPU unless the command
    line says otherwise. Returns the exit status. Raises RequestError without measured blocks."""
    per_card = parsed.per_card or per_card
    for costs in chosen_costs(measured_drives(results), results, parsed.drive, parsed.method):
        size = parsed.size or costs.size
        recording = PaperRecording(parsed.hours, parsed.cameras, size, parsed.hz, parsed.speed_kmh)
        for line in _lines(recording, costs, parsed.cards, per_card, results):
            print(line)
    return 0


def _lines(
    recording: PaperRecording, costs: BlockCosts, cards: list[int], per_card: int, results: Path
) -> Iterator[str]:
    """The estimate in words."""
    least, most = on_paper(recording, costs)
    on_gpu = not any(device.startswith("cpu") for device in costs.devices)
    unit, (width, height) = "GPU" if on_gpu else "machine", recording.size
    iterations = " or ".join(f"{steps:,}" for steps in costs.iterations) or "unknown"

    def times(seconds: Callable[[PaperEstimate], float], words: Callable[[float], str] = spelled) -> str:
        """Both bounds in words, one where they are almost the same."""
        low, high = seconds(least), seconds(most)
        return words(high) if high < 1.1 * low else f"{words(low)} to {words(high)}"

    def hours(seconds: float) -> str:
        return f"{seconds / 3600:,.1f}"

    yield (
        f"{costs.method}, by {costs.blocks} measured blocks of {costs.drive} in {results}/ "
        f"({', '.join(costs.devices) or 'unknown device'}; {iterations} iterations; {costs.images:,.0f} images of "
        f"{costs.size[0]}x{costs.size[1]} in a block)"
    )
    yield (
        f"  {recording.metres / 1000:.1f} km in {least.blocks:,} blocks of {costs.length_m:g} m with "
        f"{least.images:,.0f} images of {width}x{height} each"
    )
    yield (
        f"  a block: {times(lambda one: one.device_seconds)} of training and evaluation, "
        f"{times(lambda one: one.other_seconds)} of other jobs, {_memory(least, on_gpu)}"
    )
    together = f" ({per_card} trainings at a time)" * (per_card > 1)
    yield (
        f"  all blocks: {times(lambda one: one.blocks * one.device_seconds / per_card, hours)} {unit} hours{together}, "
        f"{times(lambda one: one.blocks * one.other_seconds, hours)} hours of other jobs on processors"
    )
    for count in cards:
        wall = times(lambda one, count=count: one.wall_seconds(count, per_card))
        yield f"  wall time on {count} {unit}{'s' * (count > 1)}: {wall}"
    yield f"  of which before the first block: {times(lambda one: one.first_seconds)}"
    yield f"  disk: {least.disk * 1e-9:,.1f} GB"
    yield (
        "  for metrics.json, if processors keep up; on disk also what else the measured blocks have. Where images "
        "differ from those measured, times are bounds (docs/costs.md)"
    )


def _memory(found: PaperEstimate, on_gpu: bool) -> str:
    if not on_gpu or found.memory_gb is None:
        return f"images of {found.image_gb:.1f} GB in memory (GPU memory not measured)"
    return f"{found.memory_gb:.1f} GB of GPU memory, of which its images take {found.image_gb:.1f} GB"


def _above_zero(kind: Callable[[str], Any]) -> Callable[[str], Any]:
    def number(text: str) -> Any:
        value = kind(text)
        if not 0 < value < 1e6:
            raise argparse.ArgumentTypeError(f"{text} is not above 0 and below a million")
        return value

    return number


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no size; write width and height in pixels: 1600x900")
    return int(found[1]), int(found[2])


def _numbers(text: str) -> list[int]:
    if not re.fullmatch(r"[1-9]\d{0,4}(,[1-9]\d{0,4})*", text):
        raise argparse.ArgumentTypeError(f"{text!r} are no numbers of GPUs; write 1,8,64")
    return [int(number) for number in text.split(",")]
