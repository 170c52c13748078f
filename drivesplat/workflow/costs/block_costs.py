"""What the blocks of long drives took, and what those of a longer recording would: an estimate on paper.

Nothing is assumed of machines: all figures are those of blocks that were trained in a results folder, scaled by the
numbers and the pixels of images.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from drivesplat.errors import RequestError
from drivesplat.io.storage import read_record, unreadable
from drivesplat.settings.blocks import BLOCKS, block_scene_name
from drivesplat.workflow.costs.measured import TRAIN, Cost, read_costs

EVALUATE = "evaluate"
STAGES_OF_DRIVES = ("extract", "refine_poses", "blocks")
"""Stages of a whole drive, which come before those of its blocks."""
PICTURES = ("compare", "tracks", "film_page")
"""Stages of scenes that metrics.json does not need."""
RESULTS_OF_METHODS = ("train.json", "eval.json")
"""Files of which the folder of a method has one."""
BYTES_PER_PIXEL = 3
"""Of a training image in memory."""


@dataclass(frozen=True)
class PaperRecording:
    """A recording that need not exist: its `hours`, the number of its `cameras` and the `size` (width and height in
    pixels) of their training images, images a second of each camera, and the speed in km/h."""

    hours: float
    cameras: int
    size: tuple[int, int]
    hz: float
    speed_kmh: float

    @property
    def metres(self) -> float:
        """The length of its path."""
        return 1000.0 * self.hours * self.speed_kmh

    @property
    def pixels(self) -> int:
        """The pixels of an image."""
        return self.size[0] * self.size[1]

    def images(self, metres: float) -> float:
        """The images of all cameras on so many metres of its path."""
        return self.cameras * self.hz * metres / (self.speed_kmh / 3.6)


@dataclass(frozen=True)
class BlockCosts:
    """What the blocks of a `drive` took with a `method`, of those that have been measured (`blocks`): means of the
    numbers of their training images, of all `cameras`, of the seconds of their trainings, evaluations and of all other
    stages, and of the bytes of their results, those of the method and all others. `size` is the width and height of an
    image in pixels; `model_gb` the least GPU memory that held any training without its images (None: not measured). For
    the stages of the whole drive seconds and bytes for each of its images."""

    drive: str
    method: str
    blocks: int
    length_m: float
    overlap_m: float
    devices: tuple[str, ...]
    iterations: tuple[int, ...]
    cameras: int
    images: float
    size: tuple[int, int]
    train_seconds: float
    evaluate_seconds: float
    other_seconds: float
    method_bytes: float
    scene_bytes: float
    model_gb: float | None
    drive_seconds_per_image: float
    drive_bytes_per_image: float

    @property
    def pixels(self) -> int:
        """The pixels of an image."""
        return self.size[0] * self.size[1]


def measured_drives(results: Path) -> list[BlockCosts]:
    """The costs of drives with trained and evaluated blocks in a results folder, of each method, those with the most
    blocks first. Raises ResultError for damaged files."""
    costs, _ = read_costs(results)
    found = []
    for file in sorted(results.glob(f"*/{BLOCKS}")):
        drive = file.parent.name
        record = read_record(file, "blocks", "blocks", "provenance")
        own = {block_scene_name(drive, number): block for number, block in enumerate(record["blocks"])}
        for method in sorted({cost.job.method for cost in costs if cost.job.scene in own and cost.job.stage == TRAIN}):
            try:
                measured = _measured(results, drive, method, own, record, costs)
            except (KeyError, TypeError, ValueError) as error:
                raise unreadable(file, "blocks", f"not the record of blocks ({error})") from error
            found += [measured] if measured else []
    return sorted(found, key=lambda one: (-one.blocks, one.drive, one.method))


def _measured(
    results: Path, drive: str, method: str, blocks: dict[str, Any], record: dict[str, Any], costs: Sequence[Cost]
) -> BlockCosts | None:
    """The costs of a drive's blocks with a method; None where none was trained and evaluated."""
    trained = {cost.job.scene: cost for cost in costs if (cost.job.stage, cost.job.method) == (TRAIN, method)}
    evaluated = {cost.job.scene: cost for cost in costs if (cost.job.stage, cost.job.method) == (EVALUATE, method)}
    files = {name: results / name / method / "eval.json" for name in blocks if name in trained and name in evaluated}
    protocols = {name: _protocol(file) for name, file in files.items() if file.is_file()}
    if not protocols:
        return None
    images = {name: protocol.images for name, protocol in protocols.items()}
    width, height = next(protocol.size for protocol in protocols.values())
    models = [
        memory - images[name] * width * height * BYTES_PER_PIXEL * 1e-9
        for name in protocols
        if (memory := trained[name].gpu_memory_gb) is not None
    ]
    used_us = sum(_length(blocks[name]["used"]) for name in protocols)
    of_drive = sum(images.values()) * sum(_length(block["core"]) for block in blocks.values()) / used_us
    own = [cost for cost in costs if cost.job.scene in protocols]
    cut = record["provenance"]["stages"]["blocks"]["settings"]["blocks"]
    return BlockCosts(
        drive=drive,
        method=method,
        blocks=len(protocols),
        length_m=record.get("length_m") or cut["length_m"],
        overlap_m=cut["overlap_m"],
        devices=tuple(sorted({device for name in protocols if (device := trained[name].device)})),
        iterations=tuple(sorted({steps for name in protocols if (steps := trained[name].iterations)})),
        cameras=max(protocol.cameras for protocol in protocols.values()),
        images=fmean(images.values()),
        size=(width, height),
        train_seconds=fmean(trained[name].seconds for name in protocols),
        evaluate_seconds=fmean(evaluated[name].seconds for name in protocols),
        other_seconds=sum(cost.seconds for cost in own if not cost.job.method and cost.job.stage not in PICTURES)
        / len(protocols),
        method_bytes=fmean(_bytes([results / name / method]) for name in protocols),
        scene_bytes=fmean(_bytes(_of_scene(results / name)) for name in protocols),
        model_gb=max(models, default=None),
        drive_seconds_per_image=sum(
            cost.seconds for cost in costs if cost.job.scene == drive and cost.job.stage in STAGES_OF_DRIVES
        )
        / of_drive,
        drive_bytes_per_image=_bytes(_of_scene(results / drive)) / of_drive,
    )


@dataclass(frozen=True)
class _Protocol:
    """The training images of a block, their width and height in pixels, and the number of cameras."""

    images: float
    size: tuple[int, int]
    cameras: int


def _protocol(file: Path) -> _Protocol:
    """The protocol of an eval.json. Raises ResultError, which names the file, where it is damaged."""
    found = read_record(file, EVALUATE, "protocol")["protocol"]
    try:
        size = int(found["width"]), int(found["height"])
        return _Protocol(float(found["train_images"]), size, len(found["cameras"]))
    except (KeyError, TypeError, ValueError) as error:
        raise unreadable(file, EVALUATE, f"its protocol is damaged ({type(error).__name__}: {error})") from error


def _length(intervals: Iterable[Sequence[int]]) -> int:
    return sum(end - first for first, end in intervals)


def _of_scene(folder: Path) -> list[Path]:
    """What lies in the folder of a scene, without the folders of methods."""
    return [path for path in folder.iterdir() if not any((path / name).is_file() for name in RESULTS_OF_METHODS)]


def _bytes(places: Iterable[Path]) -> float:
    """The bytes of files and of all files in folders."""
    every = (file for place in places for file in ([place] if place.is_file() else place.rglob("*")))
    return float(sum(file.lstat().st_size for file in every if file.is_file()))


def chosen_costs(found: Sequence[BlockCosts], results: Path, drive: str | None, method: str | None) -> list[BlockCosts]:
    """The costs of a drive, by default of the one with the most measured blocks, of one or of all methods. Raises
    RequestError where there are none."""
    matching = [one for one in found if drive in (None, one.drive) and method in (None, one.method)]
    if not matching:
        known = ", ".join(f"{one.drive} ({one.method}, {one.blocks} blocks)" for one in found) or "none"
        of = "".join([f" of {drive}" if drive else "", f" with {method}" if method else ""])
        raise RequestError(
            f"{results}/ has no measured blocks{of}, by which longer recordings are estimated; there are: {known}. "
            "Make metrics.json of a drive of a few minutes with blocks first (docs/long_drives.md)"
        )
    return [one for one in matching if one.drive == matching[0].drive]


@dataclass(frozen=True)
class PaperEstimate:
    """What the figures (metrics.json) of a recording take with one method: the number of blocks, training images of a
    block, seconds on a device and of other stages for a block, seconds before the first block, the memory of a training
    in GB (None: not measured), of which its images take `image_gb`, and bytes on disk."""

    blocks: int
    images: float
    device_seconds: float
    other_seconds: float
    first_seconds: float
    memory_gb: float | None
    image_gb: float
    disk: float

    def wall_seconds(self, cards: int, per_card: int) -> float:
        """The wall time with blocks on `cards`, `per_card` at a time on each, if processors keep up: the whole drive's
        stages, those of the first blocks, then trainings and evaluations."""
        rounds = math.ceil(self.blocks / (cards * per_card))
        return self.first_seconds + self.other_seconds + rounds * self.device_seconds


def on_paper(recording: PaperRecording, costs: BlockCosts) -> tuple[PaperEstimate, PaperEstimate]:
    """The least and the most that a recording takes by measured blocks. Its blocks have other images than these: the
    seconds of a training grow with the pixels of an image at most in proportion, those of an evaluation also with the
    images of one camera, those of other stages with all images, and at least not at all; likewise where they become
    less. Bytes and memory are in proportion. The stages of the whole drive take as long for each image at least."""
    metres = min(recording.metres, costs.length_m + 2.0 * costs.overlap_m)
    images, size = recording.images(metres), recording.pixels / costs.pixels
    share, every = size * images / costs.images, recording.images(recording.metres)
    evaluated = size * (images / recording.cameras) / (costs.images / costs.cameras)
    image_gb = images * recording.pixels * BYTES_PER_PIXEL * 1e-9
    blocks = max(1, int(recording.metres / costs.length_m + 0.5))
    of_blocks = blocks * (costs.method_bytes + share * costs.scene_bytes)

    def bound(of: Callable[[float, float], float]) -> PaperEstimate:
        return PaperEstimate(
            blocks=blocks,
            images=images,
            device_seconds=of(1.0, size) * costs.train_seconds + of(1.0, evaluated) * costs.evaluate_seconds,
            other_seconds=of(1.0, share) * costs.other_seconds,
            first_seconds=of(1.0, size) * every * costs.drive_seconds_per_image,
            memory_gb=None if costs.model_gb is None else costs.model_gb + image_gb,
            image_gb=image_gb,
            disk=of_blocks + size * every * costs.drive_bytes_per_image,
        )

    return bound(min), bound(max)
