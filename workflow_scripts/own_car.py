"""scene.json, its images and its sweeps into own_car.json."""

from drivesplat.job import job
from drivesplat.own_car_search import own_car_record
from drivesplat.scene import read_scene
from drivesplat.settings.own_car import OwnCarJob
from drivesplat.storage import write_json

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    record = own_car_record(scene, current.settings(OwnCarJob))
    write_json(current.output.own_car, {**record, "provenance": current.provenance(scene.provenance)})
