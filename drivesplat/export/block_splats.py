"""The stage `export_blocks`: the static world of a long drive, a PLY for each block, in which no place stands twice."""

import logging
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from drivesplat.export.trained_parts import digests
from drivesplat.io.storage import Provenance
from drivesplat.model.checkpoint import read_checkpoint, trained_model
from drivesplat.model.gaussians import Gaussians, concatenate, with_sh_degree
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.splat_ply import write_splat_ply
from drivesplat.scene.blocks import Blocks
from drivesplat.scene.scene import Scene
from drivesplat.settings.export import BlockSplatsJob

log = logging.getLogger(__name__)

SCHEMA = 1
CONVENTIONS = {
    "file": "A PLY of 3D Gaussian Splatting, of the static Gaussians, in metres, z up.",
    "translation": "From a file's coordinates to those of the drive, in metres: drive = file + translation.",
    "origin": "From the drive's coordinates to the dataset's global frame: global = drive + origin.",
    "lower": "The least x, y, z of the file's centres, in the file's coordinates; upper: the largest.",
    "left_out": "Blocks without a file. What others know of their place is in the files of these.",
    "core": "The intervals [first, end) in microseconds in which the vehicle is in the block.",
}


def export_blocks(
    folder: Path, scene: Scene, blocks: Blocks, checkpoints: Sequence[str], job: BlockSplatsJob
) -> tuple[dict[str, Any], list[Provenance]]:
    """Writes a PLY of every block that is not left out into a folder, from their checkpoints in order. A Gaussian
    belongs to the one of these blocks whose path is nearest to it. Returns the content of the index without provenance,
    and the provenances of the checkpoints."""
    entries, upstream = [], []
    for number, path in zip(blocks.without(job.left_out), checkpoints, strict=True):
        name = blocks.names[number]
        checkpoint, origin = read_checkpoint(path), blocks.blocks[number].origin
        upstream.append(checkpoint.provenance)
        every = _static(trained_model(checkpoint))
        own = every[owned(every, blocks, number, job.left_out)]
        log.info("%s: %d of %d static Gaussians", name, len(own), len(every))
        note = {"scene": name, "origin": (scene.origin + origin).tolist(), **digests(checkpoint.provenance)}
        write_splat_ply(folder / f"{name}.ply", with_sh_degree(own, job.sh_degree or 0), note)
        bounds = {"lower": own.means.amin(dim=0).tolist(), "upper": own.means.amax(dim=0).tolist()} if len(own) else {}
        entries.append(
            {
                "scene": name,
                "file": f"{name}.ply",
                "translation": origin.tolist(),
                "gaussians": len(own),
                **bounds,
                "core": blocks.blocks[number].core.tolist(),
            }
        )
    for number in job.left_out:  # of an earlier run
        (folder / f"{blocks.names[number]}.ply").unlink(missing_ok=True)
    index = {"schema": SCHEMA, "scene": scene.name, "origin": scene.origin.tolist(), "conventions": CONVENTIONS}
    return {**index, "blocks": entries, "left_out": [blocks.names[number] for number in job.left_out]}, upstream


def owned(gaussians: Gaussians, blocks: Blocks, number: int, left_out: Collection[int]) -> Bool[Tensor, " n"]:
    """The mask of the Gaussians of a block, in its world, that belong to it: of the blocks that are not left out, its
    path is the nearest to them."""
    places = gaussians.means.detach().double().numpy()[:, :2] + blocks.blocks[number].origin[:2]
    return torch.from_numpy(blocks.nearest(places, left_out) == number)


@torch.no_grad()
def _static(model: SplatModel) -> Gaussians:
    """The Gaussians of a model that do not move and that are finite."""
    sets = [part.sample(part.state(0.0)) for part in model.parts if not (part.has_objects or part.moves)]
    every = concatenate(sets)
    finite = torch.stack([values.flatten(1).isfinite().all(dim=1) for values in _columns(every)]).all(dim=0)
    return every[finite]


def _columns(gaussians: Gaussians) -> list[torch.Tensor]:
    return [values.reshape(len(gaussians), -1) for values in gaussians.tensors.values()]
