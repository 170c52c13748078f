"""The checkpoints of a drive's blocks as scene.usd, and a payload for each beside it."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.export.block_usd import FOLDER, BlockFiles, export_payloads, write_drive
from drivesplat.scene.blocks import read_blocks
from drivesplat.scene.scene import read_scene
from drivesplat.settings.export import BlockUsdJob

with job(snakemake) as current:
    files, settings = current.input, current.settings(BlockUsdJob)
    scene, blocks, path = read_scene(files.scene), read_blocks(files.blocks), Path(current.output.usd)
    own = [BlockFiles(*of_block) for of_block in zip(files.scenes, files.checkpoints, files.far, strict=True)]
    payloads, upstream = export_payloads(path.parent / FOLDER, scene, blocks, own, settings)
    write_drive(path, scene, payloads, settings, current.provenance(scene.provenance, *upstream))
