"""scene.json, its images and its sweeps into own_car.json."""

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.preprocess.ego_mask import ego_mask_record
from drivesplat.scene.scene import read_scene
from drivesplat.settings.masks import EgoMaskJob

with job(snakemake, dataset=("images", "sweeps")) as current:
    scene = read_scene(current.input.scene)
    record = ego_mask_record(scene, current.settings(EgoMaskJob))
    write_json(current.output.own_car, {**record, "provenance": current.provenance(scene.provenance)})
