"""The stage `film_blocks`: the film of a long drive, of which one block at a time is in memory."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from drivesplat.io.storage import Provenance
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import open_model, read_checkpoint
from drivesplat.rendering.captions import drive_captions, text_picture
from drivesplat.rendering.film import Shot, encode_film, shot_of
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.rendering.frames import film_frames
from drivesplat.rendering.panels import Panels
from drivesplat.scene.blocks import Blocks, within
from drivesplat.scene.scene import Scene, read_scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import BlockFilmJob
from drivesplat.trajectories.camera_path import CameraPath, film_path

FramesOf = Callable[[Shot, int, Sequence[int]], Iterator[np.ndarray]]
"""Gives some frames (h, w, 3) uint8 of a shot, by their indices, as the block of a number shows them."""
BLEND_M = 5.0
"""Metres of path before and after a border between blocks in which images of both are blended."""
LEFT_OUT = "block {} left out"
"""What frames of a block that is left out show, on dark grey."""


@dataclass(frozen=True)
class BlockShare:
    """What the block of a frame contributes to it: all, or `weight` beside what the block `other` contributes."""

    number: int
    other: int | None = None
    weight: float = 1.0


def block_shares(blocks: Blocks, path: CameraPath, left_out: Collection[int] = ()) -> list[BlockShare]:
    """The blocks of each frame of a path: from BLEND_M before a border to BLEND_M behind it, one block fades into the
    other, as far as both have recordings there and neither is `left_out`."""
    places, stamps = path.camera_to_world[:, :3, 3], path.timestamps
    arcs = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    numbers = [blocks.at(int(timestamp)) for timestamp in stamps]
    shares = [BlockShare(number) for number in numbers]
    for after in (np.flatnonzero(np.diff(numbers)) + 1).tolist():
        border = 0.5 * (arcs[after - 1] + arcs[after])
        for i in np.flatnonzero(np.abs(arcs - border) < BLEND_M).tolist():
            own, other = (after - 1, after) if i < after else (after, after - 1)
            known = within(stamps[i : i + 1], blocks.blocks[numbers[other]].used)[0]
            if numbers[i] == numbers[own] and known and not {numbers[i], numbers[other]} & {*left_out}:
                weight = 0.5 + 0.5 * abs(arcs[i] - border) / BLEND_M
                shares[i] = BlockShare(numbers[i], numbers[other], float(weight))
    return shares


class OpenBlocks:
    """The models of a drive's blocks, given by the files of those that are not left out, in order. The last two that
    were used are in memory."""

    def __init__(
        self,
        blocks: Blocks,
        left_out: Collection[int],
        scenes: Sequence[str],
        checkpoints: Sequence[str],
        device_settings: DeviceSettings,
    ):
        files = zip(scenes, checkpoints, strict=True)
        self._files = dict(zip(blocks.without(left_out), files, strict=True))
        self._device_settings = device_settings
        self._open: dict[int, tuple[FixedModel, Scene, torch.device]] = {}
        self._provenances: dict[int, Provenance] = {}

    def __len__(self) -> int:
        return sum(len(fixed.model) for fixed, *_ in self._open.values())

    @property
    def upstream(self) -> list[Provenance]:
        """The provenances of the checkpoints of all blocks that were used."""
        return list(self._provenances.values())

    def frames(self, shot: Shot, number: int, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """Some frames of a shot, as a block shows them."""
        fixed, scene, device = self.block(number)
        within = shot_in_block(shot, slice(indices[0], indices[-1] + 1), scene)
        fixed.model.precompute(within.seconds)
        return film_frames(fixed, ((view, None) for view in within.views(device)))

    def block(self, number: int) -> tuple[FixedModel, Scene, torch.device]:
        """The model of a block, its scene, and the device of the model."""
        if number not in self._open:
            while len(self._open) > 1:
                self._open.pop(next(iter(self._open)))
            scene, file = self._files[number]
            checkpoint = read_checkpoint(file)
            self._provenances[number] = checkpoint.provenance
            model, device = open_model(checkpoint, self._device_settings)
            self._open[number] = FixedModel(model), read_scene(scene), device
        self._open[number] = self._open.pop(number)
        return self._open[number]


def render_block_film(
    scene: Scene,
    blocks: Blocks,
    scenes: Sequence[str],
    checkpoints: Sequence[str],
    job: BlockFilmJob,
    device_settings: DeviceSettings,
    path: Path,
) -> tuple[dict[str, Any], list[Provenance]]:
    """Writes the MP4 `path` of a drive from the files of its blocks that are not left out, in order; frames of those
    that are say so. Returns the content of the record of its cameras as `render_film` does, with the names of blocks
    that are `left_out`, and the provenances of the checkpoints. Raises what `render_film` raises."""
    shot = shot_of(scene, film_path(scene, job.camera, job.fps, job.trajectory), job)
    panels = Panels((f"{path.parent.name}: {job.trajectory.in_words}",), shot.size)
    captions = drive_captions(panels.labels, shot.seconds, shot.trained_until)
    opened = OpenBlocks(blocks, job.left_out, scenes, checkpoints, device_settings)
    with explain_out_of_memory(lambda: len(opened)):
        frames = zip(block_pictures(shot, blocks, opened.frames, job.left_out), captions, strict=True)
        figures = encode_film(path, frames, len(captions), panels, shot.format)
    offset = job.trajectory.model_dump(exclude={"parts"})
    left_out = [blocks.names[number] for number in job.left_out]
    record = {**shot.record(), "offset": offset, "parts": "all", "left_out": left_out, **figures}
    return record, opened.upstream


def block_pictures(
    shot: Shot, blocks: Blocks, frames_of: FramesOf, left_out: Collection[int], driven: CameraPath | None = None
) -> Iterator[np.ndarray]:
    """The frames (h, w, 3) uint8 of a shot: blended near borders, and dark in blocks that are left out. `driven` has
    the timestamps that tell the block of each frame; None: those of the shot."""
    shares = block_shares(blocks, driven or shot.cameras, left_out)
    for (number, other), run in groupby(range(len(shares)), lambda i: (shares[i].number, shares[i].other)):
        indices = list(run)
        if number in left_out:
            yield from [text_picture(LEFT_OUT.format(number), shot.size)] * len(indices)
            continue
        own = frames_of(shot, number, indices)
        if other is None:
            yield from own
            continue
        for i, one, two in zip(indices, own, frames_of(shot, other, indices), strict=True):
            yield cv2.addWeighted(one, shares[i].weight, two, 1.0 - shares[i].weight, 0.0)


def shot_in_block(shot: Shot, frames: slice, block: Scene) -> Shot:
    """Some frames of a shot, in the world of a block's scene."""
    cameras = shot.cameras[frames]
    poses = cameras.camera_to_world.copy()
    poses[:, :3, 3] += shot.scene.origin - block.origin
    return replace(shot, scene=block, cameras=replace(cameras, camera_to_world=poses))
