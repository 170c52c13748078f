"""scene.json into actors.pkl."""

from drivesplat.job import job
from drivesplat.scene import read_scene
from drivesplat.seeding.actor_points import actors_record
from drivesplat.settings.actor_seed import ActorSeedJob
from drivesplat.storage import write_plain_pickle

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    record = actors_record(scene, current.settings(ActorSeedJob))
    write_plain_pickle(current.output.actors, {**record, "provenance": current.provenance(scene.provenance)})
