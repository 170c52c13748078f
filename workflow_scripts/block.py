"""scene.json of a long drive and its blocks.json into the scene.json of a block."""

from dataclasses import replace

from drivesplat.workflow.job import job
from drivesplat.preprocess.blocks import block_scene
from drivesplat.scene.blocks import read_blocks
from drivesplat.scene.scene import read_scene, write_scene
from drivesplat.settings.blocks import BlocksJob

with job(snakemake) as current:
    drive, blocks = read_scene(current.input[0]), read_blocks(current.input[1])
    name = current.wildcards.scene
    scene = block_scene(drive, blocks, blocks.names.index(name), current.settings(BlocksJob).holdout)
    current.record_dataset(
        images=(frame.image_path for frame in scene.frames),
        sweeps=(sweep.path for sweep in scene.sweeps),
        classes=(frame.classes_path for frame in scene.frames if frame.classes_path),
    )
    # not that of the drive, which may have been extracted again without a change of this block
    provenance = current.provenance(inputs={name: snakemake.params.recordings})
    write_scene(current.output.scene, replace(scene, provenance=provenance))
