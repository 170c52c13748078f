"""The checkpoints of a drive's blocks as one PLY each, and their index."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.export.block_splats import export_blocks
from drivesplat.io.storage import write_json
from drivesplat.scene.blocks import read_blocks
from drivesplat.scene.scene import read_scene
from drivesplat.settings.export import BlockSplatsJob

with job(snakemake) as current:
    scene, blocks = read_scene(current.input.scene), read_blocks(current.input.blocks)
    job_settings, folder = current.settings(BlockSplatsJob), Path(current.output.index).parent
    index, upstream = export_blocks(folder, scene, blocks, current.input.checkpoints, job_settings)
    write_json(current.output.index, {**index, "provenance": current.provenance(*upstream)})
