"""scene.json and own_car.json into actors.pkl."""

from drivesplat.job import job
from drivesplat.own_car import read_own_car
from drivesplat.scene import read_scene
from drivesplat.seeding.actor_points import actors_record
from drivesplat.settings.actor_seed import ActorSeedJob
from drivesplat.storage import write_plain_pickle

with job(snakemake) as current:
    scene, (own_car, upstream) = read_scene(current.input.scene), read_own_car(current.input.own_car)
    record = actors_record(scene, current.settings(ActorSeedJob), own_car)
    write_plain_pickle(current.output.actors, {**record, "provenance": current.provenance(scene.provenance, upstream)})
