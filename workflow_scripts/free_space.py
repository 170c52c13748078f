"""scene.json into free_space.pkl."""

from drivesplat.job import job
from drivesplat.scene import read_scene
from drivesplat.seeding.empty_space import free_space_record
from drivesplat.settings.free_space import FreeSpaceJob
from drivesplat.storage import write_plain_pickle

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    record = free_space_record(scene, current.settings(FreeSpaceJob))
    write_plain_pickle(current.output.free_space, {**record, "provenance": current.provenance(scene.provenance)})
