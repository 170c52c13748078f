"""scene.json and own_car.json into masks/."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.preprocess.masks import make_masks
from drivesplat.scene.ego_mask import read_ego_mask
from drivesplat.scene.scene import read_scene
from drivesplat.settings.masks import MaskJob

with job(snakemake, dataset=("images", "sweeps", "classes")) as current:
    scene, (ego_mask, upstream) = read_scene(current.input.scene), read_ego_mask(current.input.own_car)
    folder = Path(current.output.masks).parent
    record = make_masks(scene, current.settings(MaskJob), folder, ego_mask, current.threads)
    write_json(current.output.masks, {**vars(record), "provenance": current.provenance(scene.provenance, upstream)})
