"""scene.json of a long drive into blocks.json."""

from dataclasses import replace

from drivesplat.workflow.job import job
from drivesplat.preprocess.block_length import with_length
from drivesplat.preprocess.blocks import cut_into_blocks
from drivesplat.scene.blocks import write_blocks
from drivesplat.scene.scene import read_scene
from drivesplat.settings.blocks import BlocksJob

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    job_settings, reason = with_length(scene, current.settings(BlocksJob))
    blocks, provenance = cut_into_blocks(scene, job_settings), current.provenance(scene.provenance)
    write_blocks(current.output.blocks, replace(blocks, provenance=provenance, reason=reason))
