"""scene.json and own_car.json into actors.pkl."""

from drivesplat.workflow.job import job
from drivesplat.io.plain_pickle import write_plain_pickle
from drivesplat.preprocess.actor_seed import actors_record
from drivesplat.scene.ego_mask import read_own_car
from drivesplat.scene.scene import read_scene
from drivesplat.settings.actor_seed import ActorSeedJob

with job(snakemake, dataset=("images", "sweeps")) as current:
    scene, (own_car, upstream) = read_scene(current.input.scene), read_own_car(current.input.own_car)
    record = actors_record(scene, current.settings(ActorSeedJob), own_car)
    write_plain_pickle(current.output.actors, {**record, "provenance": current.provenance(scene.provenance, upstream)})
