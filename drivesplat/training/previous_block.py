"""A training of a block that starts from the trained model of the block before it (docs/long_drives.md)."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from drivesplat.model.checkpoint import TrainedCheckpoint, read_checkpoint, trained_model
from drivesplat.model.handover import Handover
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.training_record import TrainingRecord, read_training_record

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PreviousBlock:
    """The block before one: its training record and its checkpoint."""

    record: TrainingRecord
    checkpoint: TrainedCheckpoint


def read_previous(parser: Sequence[str], checkpoint: Sequence[str]) -> PreviousBlock | None:
    """Reads the block before one from its files; None without files."""
    if not parser:
        return None
    return PreviousBlock(read_training_record(parser[0]), read_checkpoint(checkpoint[0]))


def start_from(model: SplatModel, record: TrainingRecord, previous: PreviousBlock, cap_max: int) -> None:
    """Lets an untrained model of a block, on the CPU, start from that of the block before: static Gaussians at places
    that are not nearer to the path of that block alone, objects of both, the sky, and exposures. Static parts have at
    most `cap_max` Gaussians, unless they have a limit of their own. Nothing happens where the blocks share no image."""
    handover, other = handover_between(previous.record, record, cap_max), trained_model(previous.checkpoint)
    if handover is None:
        log.warning("the block shares no image with the block before it, and starts alone")
        return
    seeds, parts = len(model), {part.name: part for part in other.parts}
    for part in model.parts:
        if part.name in parts:
            part.take_over(parts[part.name], handover)
    if model.exposure is not None and other.exposure is not None:
        model.exposure.take_over(other.exposure, handover.seconds)
    if model.sky is not None and other.sky is not None:
        _take_over_sky(model.sky, other.sky)
    log.info("%d Gaussians in place of %d seeds, with those of the block before", len(model), seeds)


@torch.no_grad()
def _take_over_sky(own: torch.nn.Module, other: torch.nn.Module) -> None:
    for values, learned in zip(own.parameters(), other.parameters(), strict=True):
        if values.shape == learned.shape:
            values.copy_(learned)


def handover_between(before: TrainingRecord, here: TrainingRecord, cap_max: int) -> Handover | None:
    """From the world of a block to that of the next, by the images that both have; None without any. Both worlds have
    the same axes."""
    numbers = {image: i for i, image in enumerate(_images(before))}
    pairs = np.array([(numbers[image], i) for i, image in enumerate(_images(here)) if image in numbers], dtype=int)
    if not len(pairs):
        return None
    places = [record.ego_to_world[:, :3, 3] for record in (before, here)]
    shift = np.median(places[1][pairs[:, 1]] - places[0][pairs[:, 0]], axis=0)
    seconds = float(before.timestamps.min() - here.timestamps.min()) * 1e-6
    return Handover(shift, seconds, (places[0] + shift)[:, :2], places[1][:, :2], cap_max)


def _images(record: TrainingRecord) -> list[tuple[str, int]]:
    """The images of a record by camera and timestamp."""
    return [(record.camera_name(i), int(timestamp)) for i, timestamp in enumerate(record.timestamps)]
