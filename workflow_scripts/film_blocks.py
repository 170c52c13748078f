"""The checkpoints of a drive's blocks along a trajectory, into an MP4 and the record of its cameras."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.rendering.block_film import render_block_film
from drivesplat.scene.blocks import read_blocks
from drivesplat.scene.scene import read_scene
from drivesplat.settings.render import BlockFilmJob

with job(snakemake) as current:
    files, scene = current.input, read_scene(current.input.scene)
    blocks = read_blocks(files.blocks)
    film = Path(current.output.film)
    record, upstream = render_block_film(
        scene, blocks, files.scenes, files.checkpoints, current.settings(BlockFilmJob), current.device(), film
    )
    write_json(current.output.cameras, {**record, "provenance": current.provenance(scene.provenance, *upstream)})
