"""The actors of checkpoint.npz as assets, with their figures in eval_objects.json."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.editing.assets.stage import write_assets
from drivesplat.evaluation.object_metrics import object_figures
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.settings.export import AssetsJob

with job(snakemake) as current:
    scene, checkpoint = read_scene(current.input.scene), read_checkpoint(current.input.checkpoint)
    quality, measured = object_figures(current.input.objects)
    provenance = current.provenance(scene.provenance, checkpoint.provenance, measured)
    method, path = current.wildcards.method, Path(current.output.index)
    write_assets(path, scene, checkpoint, method, current.settings(AssetsJob), quality, provenance)
