"""The stage `usd_blocks`: a long drive as scene.usd, with a payload for each block, which programs load on demand.

scene.usd has the conventions of `drivesplat.export.usd`, in the world of the drive and with time codes since its first
image. Its prims:

- /World/blocks/{block}: the translation of the block's world, a box around all that it holds, and a payload: the file
  usd/{block}.usdc beside scene.usd, with the world and the time codes of the block
- /World/camera with the recorded path of the whole drive

No Gaussian stands twice: a static one belongs to the block whose path is nearest to it, and an object is visible in a
block while the vehicle is in that block.
"""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, Vt

from drivesplat.export.block_splats import owned
from drivesplat.export.far_gaussians import read_far, within_reach
from drivesplat.export.thinning import thinned_groups
from drivesplat.export.trained_parts import SampledGroup, digests, shown_timestamp, trained_groups
from drivesplat.export.usd import (
    EXTENT_SIGMAS,
    TIME_CODES_PER_SECOND,
    define_camera,
    identifier,
    recorded_cameras,
    splat_stage,
    world_stage,
    write_layer,
)
from drivesplat.io.storage import Provenance
from drivesplat.model.checkpoint import TrainedCheckpoint, read_checkpoint, trained_model
from drivesplat.scene.blocks import Block, Blocks
from drivesplat.scene.scene import Scene, read_scene
from drivesplat.settings.export import BlockUsdJob

log = logging.getLogger(__name__)

FOLDER, SUFFIX = "usd", ".usdc"
"""Of the payloads, beside scene.usd."""
BLOCKS = "/World/blocks"
_INSTANT = 1e-6
"""Seconds between the end of a block, which is no longer in it, and the last time at which its objects are visible."""


@dataclass(frozen=True)
class BlockFiles:
    """The files of a block that is exported: its scene.json, checkpoint.npz and far.npz."""

    scene: str
    checkpoint: str
    far: str


@dataclass(frozen=True)
class Payload:
    """A block's file, named `{scene}.usdc`. `translation` (3,) is from its world to the drive's in metres, `seconds`
    from the first image of the drive to that of the block. `bounds` (2, 3) are the corners of a box around all of its
    Gaussians at all times, in the block's world; None without Gaussians."""

    scene: str
    translation: Float64[np.ndarray, "3"]
    seconds: float
    bounds: Float64[np.ndarray, "2 3"] | None
    gaussians: int


@torch.no_grad()
def export_payloads(
    folder: Path, scene: Scene, blocks: Blocks, files: Sequence[BlockFiles], job: BlockUsdJob
) -> tuple[list[Payload], list[Provenance]]:
    """Writes the payload of every block of the drive `scene` that is not left out into a folder, from the files of
    these blocks in order, and removes those of an earlier run. Each has at most `job.gaussians` Gaussians, those with
    the largest coverage. Returns the payloads and the provenances of the checkpoints.

    Raises ResultError if a file cannot be written, ConfigError where `job.time_s` is after the drive.
    """
    payloads, upstream = [], []
    shown = shown_timestamp(scene, job.time_s)
    for number, own in zip(blocks.without(job.left_out), files, strict=True):
        checkpoint, block_scene = read_checkpoint(own.checkpoint), read_scene(own.scene)
        upstream.append(checkpoint.provenance)
        reachable = within_reach(checkpoint, read_far(own.far))
        every = _groups(reachable, block_scene, job.eval_camera, shown)
        groups = thinned_groups(dict(_of_block(every, block_scene, blocks, number, job.left_out)), job.gaussians)
        note = {"scene": block_scene.name, "origin": Gf.Vec3d(*block_scene.origin), **digests(checkpoint.provenance)}
        write_layer(folder / f"{block_scene.name}{SUFFIX}", splat_stage(groups, (), note))
        count, before = (sum(len(group.gaussians) for group in of.values()) for of in (groups, every))
        log.info("%s: %d of %d Gaussians, %d groups", block_scene.name, count, before, len(groups))
        start = min(frame.timestamp for frame in block_scene.frames)
        payloads.append(
            Payload(block_scene.name, blocks.blocks[number].origin, scene.seconds(start), _bounds(groups), count)
        )
    for file in set(folder.glob(f"*{SUFFIX}")) - {folder / f"{payload.scene}{SUFFIX}" for payload in payloads}:
        file.unlink()
    return payloads, upstream


def write_drive(
    path: Path, scene: Scene, payloads: Iterable[Payload], job: BlockUsdJob, provenance: Provenance
) -> None:
    """Writes scene.usd of the drive `scene`, with the payloads in the folder beside it and the recorded path of
    `job.eval_camera`. Raises DatasetError if the drive lacks that camera, ResultError if the file cannot be written."""
    note = {"scene": scene.name, "dataset": scene.dataset, "origin": Gf.Vec3d(*scene.origin), **digests(provenance)}
    stage = world_stage(note)
    Usd.ModelAPI(UsdGeom.Xform.Define(stage, BLOCKS)).SetKind(Kind.Tokens.group)
    for payload in payloads:
        _define_block(stage, payload)
    define_camera(stage, recorded_cameras(scene, job.eval_camera))
    write_layer(path, stage)


def _groups(checkpoint: TrainedCheckpoint, scene: Scene, camera: str, shown: int) -> dict[str, SampledGroup]:
    """All rigid groups of a block's model. Colours are those of the block's time that is nearest to the timestamp
    `shown`, at which objects have their pose and visibility without a time."""
    stamps = [frame.timestamp for frame in scene.frames]
    time_s = scene.seconds(int(np.clip(shown, min(stamps), max(stamps))))
    recorded = np.array([frame.timestamp for frame in scene.frames if frame.camera == camera], dtype=np.int64)
    groups = trained_groups(trained_model(checkpoint), scene, recorded, time_s)
    return {
        name: group
        if group.motion is None
        else replace(group, motion=replace(group.motion, default_time=scene.seconds(shown)))
        for name, group in groups.items()
    }


def _of_block(
    groups: Mapping[str, SampledGroup], scene: Scene, blocks: Blocks, number: int, left_out: Sequence[int]
) -> Iterable[tuple[str, SampledGroup]]:
    """What the payload of a block holds of its groups, by name: static Gaussians nearest to its path, and the objects
    that are there while the vehicle is in it."""
    for name, group in groups.items():
        if group.motion is None:
            yield name, group.of_rows(owned(group.gaussians, blocks, number, left_out))
            continue
        spans = _within(group.motion.spans, scene, blocks.blocks[number])
        if spans:
            yield name, replace(group, motion=replace(group.motion, spans=spans))


def _within(spans: Iterable[tuple[float, float]], scene: Scene, block: Block) -> tuple[tuple[float, float], ...]:
    """The parts of spans of seconds, each from its first to its last, that lie in the core of a block."""
    cores = [(scene.seconds(first), scene.seconds(end) - _INSTANT) for first, end in block.core]
    found = ((max(a, first), min(b, last)) for a, b in spans for first, last in cores)
    return tuple(sorted((first, last) for first, last in found if first <= last))


def _bounds(groups: Mapping[str, SampledGroup]) -> Float64[np.ndarray, "2 3"] | None:
    """The corners of a box around all Gaussians wherever their objects are."""
    corners = []
    for group in groups.values():
        gaussians = group.gaussians
        if not len(gaussians):
            continue
        reach = EXTENT_SIGMAS * gaussians.scales.amax(dim=-1, keepdim=True)
        if group.motion is None:
            lower, upper = (gaussians.means - reach).amin(dim=0), (gaussians.means + reach).amax(dim=0)
            corners += [lower.double().cpu().numpy(), upper.double().cpu().numpy()]
            continue
        means = gaussians.means if group.shapes is None else torch.from_numpy(group.shapes.means).to(reach)
        radius = float((means.norm(dim=-1) + reach[:, 0]).max())
        centres = group.motion.object_to_world[:, :3, 3]
        corners += [centres.min(axis=0) - radius, centres.max(axis=0) + radius]
    return np.stack([np.min(corners, axis=0), np.max(corners, axis=0)]) if corners else None


def _define_block(stage: Usd.Stage, payload: Payload) -> None:
    """Defines the prim of a block. Its box and its place are known without its payload."""
    prim = UsdGeom.Xform.Define(stage, f"{BLOCKS}/{identifier(payload.scene)}")
    model = UsdGeom.ModelAPI.Apply(prim.GetPrim())
    Usd.ModelAPI(prim).SetKind(Kind.Tokens.assembly)
    if payload.bounds is not None:
        model.SetExtentsHint(Vt.Vec3fArray.FromNumpy(payload.bounds.astype(np.float32)))
    prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*payload.translation))
    prim.GetPrim().SetDisplayName(payload.scene)
    prim.GetPrim().SetCustomDataByKey("drivesplat", {"scene": payload.scene, "gaussians": payload.gaussians})
    offset = Sdf.LayerOffset(payload.seconds * TIME_CODES_PER_SECOND)
    file = f"./{FOLDER}/{payload.scene}{SUFFIX}"
    prim.GetPrim().GetPayloads().AddPayload(Sdf.Payload(file, Sdf.Path.emptyPath, offset))
