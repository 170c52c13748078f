"""The checkpoints of a drive's blocks with objects in other roles, into a film of the drive, a still and a record."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.editing.block_edit import render_block_edit
from drivesplat.editing.film import EditFiles
from drivesplat.io.storage import write_json
from drivesplat.scene.blocks import read_blocks
from drivesplat.scene.scene import read_scene
from drivesplat.settings.render import BlockEditJob

with job(snakemake) as current:
    read, scene = current.input, read_scene(current.input.scene)
    blocks, files = read_blocks(read.blocks), EditFiles(Path(current.output.film), Path(current.output.still))
    settings = current.settings(BlockEditJob)
    record, upstream = render_block_edit(
        scene, blocks, read.scenes, read.checkpoints, settings, current.device(), files
    )
    write_json(current.output.labels, {**record, "provenance": current.provenance(scene.provenance, *upstream)})
