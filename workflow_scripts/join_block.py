"""The checkpoints of a block and of those beside it into its checkpoint.npz and train.json."""

from dataclasses import replace
from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import write_checkpoint
from drivesplat.model.joined_blocks import join_files
from drivesplat.scene.blocks import read_blocks
from drivesplat.training.stage import read_summary

with job(snakemake) as current:
    summary = read_summary(current.input.summary)
    blocks = read_blocks(current.input.blocks[1])
    paths = {blocks.names.index(Path(path).parents[2].name): path for path in current.input.checkpoints}
    checkpoint, upstream = join_files(blocks, blocks.names.index(current.wildcards.scene), paths)
    provenance = current.provenance(*upstream)
    write_checkpoint(current.output.checkpoint, replace(checkpoint, provenance=provenance))
    write_json(current.output.summary, {**summary, "provenance": provenance})
