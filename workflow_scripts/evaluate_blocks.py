"""The eval.json and eval_objects.json of all blocks into those of a drive."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.evaluation.block_metrics import BlockEvaluation, pooled
from drivesplat.io.storage import write_json
from drivesplat.scene.blocks import read_blocks
from drivesplat.scene.scene import read_scene
from drivesplat.settings.blocks import PooledJob

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    blocks = read_blocks(current.input.blocks)
    measured = {Path(path).parent.parent.name: BlockEvaluation.read(path) for path in current.input.evals}
    record, objects = pooled(scene, blocks, current.settings(PooledJob), measured)
    provenance = current.provenance(*(block.provenance for block in measured.values()))
    write_json(current.output.metrics, {**record, "provenance": provenance})
    write_json(current.output.objects, {**objects, "provenance": provenance})
