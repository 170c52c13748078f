"""scene.json and seed.ply into parser.pkl."""

from drivesplat.job import job
from drivesplat.parser import parser_dict
from drivesplat.point_cloud import read_ply
from drivesplat.scene import read_scene
from drivesplat.settings.parser import ParserJob
from drivesplat.storage import write_plain_pickle

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    seed = read_ply(current.input.seed, rule="lidar_seed")
    record = parser_dict(scene, seed, current.settings(ParserJob))
    provenance = current.provenance(scene.provenance, seed.note["provenance"])
    write_plain_pickle(current.output.parser, {**record, "provenance": provenance})
