"""The stage `film_blocks`: the film of a long drive, of which one block at a time is in memory."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.io.storage import Provenance
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import open_model, read_checkpoint
from drivesplat.rendering.captions import drive_captions
from drivesplat.rendering.film import Shot, encode_film, shot_of
from drivesplat.rendering.frames import film_frames
from drivesplat.rendering.panels import Panels
from drivesplat.scene.blocks import Blocks
from drivesplat.scene.scene import Scene, read_scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import FilmJob
from drivesplat.trajectories.camera_path import film_path


def render_block_film(
    scene: Scene,
    blocks: Blocks,
    scenes: Sequence[str],
    checkpoints: Sequence[str],
    job: FilmJob,
    device_settings: DeviceSettings,
    path: Path,
) -> tuple[dict[str, Any], list[Provenance]]:
    """Writes the MP4 `path` of a drive from the files of its blocks, in order. Returns the content of the record of its
    cameras as `render_film` does, and the provenances of the checkpoints. Raises what `render_film` raises."""
    shot = shot_of(scene, film_path(scene, job.camera, job.fps, job.trajectory), job)
    panels = Panels((f"{path.parent.name}: {job.trajectory.in_words}",), shot.size)
    captions = drive_captions(panels.labels, shot.seconds, shot.trained_until)
    largest, upstream = [0], []

    def pictures() -> Iterator[np.ndarray]:
        numbers = [blocks.at(int(timestamp)) for timestamp in shot.cameras.timestamps]
        for number, frames in groupby(range(len(numbers)), numbers.__getitem__):
            indices = list(frames)
            checkpoint = read_checkpoint(checkpoints[number])
            upstream.append(checkpoint.provenance)
            model, device = open_model(checkpoint, device_settings)
            largest[0] = len(model)
            within = _part_of(shot, slice(indices[0], indices[-1] + 1), read_scene(scenes[number]))
            model.precompute(within.seconds)
            yield from film_frames(model, ((view, None) for view in within.views(device)))
            del model
            if device.type == "cuda":
                torch.cuda.empty_cache()

    with explain_out_of_memory(lambda: largest[0]):
        figures = encode_film(path, zip(pictures(), captions, strict=True), len(captions), panels, shot.format)
    offset = job.trajectory.model_dump(exclude={"parts"})
    return {**shot.record(), "offset": offset, "parts": "all", **figures}, upstream


def _part_of(shot: Shot, frames: slice, block: Scene) -> Shot:
    """Some frames of a shot, in the world of a block's scene."""
    cameras = shot.cameras[frames]
    poses = cameras.camera_to_world.copy()
    poses[:, :3, 3] += shot.scene.origin - block.origin
    return replace(shot, scene=block, cameras=replace(cameras, camera_to_world=poses))
