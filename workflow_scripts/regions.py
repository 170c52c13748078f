"""scene.json of other tracks than the annotated ones, and masks/, into the masks/ of these tracks."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.preprocess.masks import relabelled_masks
from drivesplat.scene.scene import read_scene
from drivesplat.settings.masks import RegionJob

with job(snakemake) as current:
    scene, shared = read_scene(current.input.scene), Path(current.input.masks).parent
    record = relabelled_masks(scene, current.settings(RegionJob), shared, Path(current.output.masks).parent)
    provenance = current.provenance(scene.provenance, record.provenance)
    write_json(current.output.masks, {**vars(record), "provenance": provenance})
