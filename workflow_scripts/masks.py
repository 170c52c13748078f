"""scene.json into masks/."""

from pathlib import Path

from drivesplat.job import job
from drivesplat.masks import make_masks
from drivesplat.scene import read_scene
from drivesplat.settings.masks import MaskJob
from drivesplat.storage import write_json

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    record = make_masks(scene, current.settings(MaskJob), Path(current.output.masks).parent)
    write_json(current.output.masks, {**record, "provenance": current.provenance(scene.provenance)})
