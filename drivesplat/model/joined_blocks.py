"""The model of a block of a long drive, with the static Gaussians of the blocks beside it in their places."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.io.storage import Provenance
from drivesplat.model.background import Background
from drivesplat.model.checkpoint import TrainedCheckpoint, read_checkpoint, trained_model
from drivesplat.model.parameters import OFFSETS
from drivesplat.model.part import Part
from drivesplat.model.road import RoadPart
from drivesplat.model.states import IMAGE
from drivesplat.scene.blocks import Blocks

STATIC = (Background.name, RoadPart.name)
"""The parts of which a place has those of one block alone."""


@dataclass(frozen=True)
class TrainedBlock:
    """The checkpoint of block `number`, and the place (3,) of its world's origin in the drive's world (metres)."""

    number: int
    checkpoint: TrainedCheckpoint
    origin: np.ndarray


BlockAt = Callable[[np.ndarray], np.ndarray]
"""The numbers (n,) of the blocks that places (n, 2) of the drive's world belong to."""


def joined(own: TrainedBlock, others: Sequence[TrainedBlock], block_at: BlockAt) -> TrainedCheckpoint:
    """The checkpoint of a block in which every place has the static Gaussians of one block.

    Those at places of `others` are theirs, and become part of the background; all else is the block's own: also what
    lies at places of blocks that are not given, as its cameras see it from afar; what moves, the sky and exposures.

    Raises ResultError where the methods of the blocks are not the same.
    """
    parts = [definition.part for definition in own.checkpoint.parts]
    if Background.name not in parts:
        raise ResultError(f"blocks are joined by their part {Background.name!r}, and the method has none")
    numbers = [other.number for other in others]
    model, state = trained_model(own.checkpoint), dict(own.checkpoint.model)
    for i, part in enumerate(model.parts):
        if part.name in STATIC:
            foreign = np.isin(block_at(_places(part, own)), numbers)
            state |= _rows(state, f"parts.{i}.params.", torch.from_numpy(~foreign))
    prefix = f"parts.{parts.index(Background.name)}.params."
    names = [name.removeprefix(prefix) for name in state if name.startswith(prefix)]
    added = [_background_rows(other, names, own.origin, block_at) for other in others]
    for name in names:
        state[prefix + name] = torch.cat([state[prefix + name], *(rows[name] for rows in added)])
    return replace(own.checkpoint, model=state)


def join_files(
    blocks: Blocks, number: int, paths: Mapping[int, str | Path]
) -> tuple[TrainedCheckpoint, list[Provenance]]:
    """What `joined` gives for block `number` and those beside it, from their checkpoints by number; and the provenances
    of all of them."""
    trained = {i: TrainedBlock(i, read_checkpoint(path), blocks.blocks[i].origin) for i, path in sorted(paths.items())}
    numbers = sorted(trained)
    others = [trained[i] for i in numbers if i != number]
    found = joined(trained[number], others, lambda places: blocks.nearest(places, numbers))
    return found, [one.checkpoint.provenance for one in trained.values()]


def _places(part: Part, block: TrainedBlock) -> np.ndarray:
    """The places (n, 2) of a part's Gaussians in the drive's world."""
    means: Tensor = part.params["means"]
    return means.detach().double().numpy()[:, :2] + block.origin[:2]


def _rows(state: dict[str, Tensor], prefix: str, kept: Tensor) -> dict[str, Tensor]:
    return {name: values[kept] for name, values in state.items() if name.startswith(prefix)}


@torch.no_grad()
def _background_rows(
    block: TrainedBlock, names: Sequence[str], origin: np.ndarray, block_at: BlockAt
) -> dict[str, Tensor]:
    """The static Gaussians of a block at its own places, as rows of a background of these parameters in a world with
    this origin."""
    shift = torch.from_numpy(block.origin - origin).float()
    found: list[dict[str, Tensor]] = []
    for part in trained_model(block.checkpoint).parts:
        if part.name not in STATIC:
            continue
        rows = {name: values.detach() for name, values in part.params.items()}
        if part.name == RoadPart.name:
            flat = part.sample(part.state(0.0, IMAGE), IMAGE)
            rows |= {"means": flat.means, "quats": flat.quats, "scales": torch.log(flat.scales)}
            rows |= {name: torch.zeros_like(rows[offset_of]) for offset_of, name in OFFSETS.items() if name in names}
        if set(rows) != set(names):
            raise ResultError("blocks that belong together were trained by different methods; train them again")
        rows["means"] = rows["means"] + shift
        mine = torch.from_numpy(block_at(_places(part, block)) == block.number)
        found.append({name: values[mine] for name, values in rows.items()})
    return {name: torch.cat([rows[name] for rows in found]) for name in names}
