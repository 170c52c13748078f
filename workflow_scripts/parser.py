"""scene.json and seed.ply into parser.pkl."""

from drivesplat.workflow.job import job
from drivesplat.io.point_cloud import read_ply
from drivesplat.io.storage import write_plain_pickle
from drivesplat.preprocess.parser import parser_dict
from drivesplat.scene.scene import read_scene
from drivesplat.settings.parser import ParserJob

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    seed = read_ply(current.input.seed, rule="lidar_seed")
    record = parser_dict(scene, seed, current.settings(ParserJob))
    provenance = current.provenance(scene.provenance, seed.note["provenance"])
    write_plain_pickle(current.output.parser, {**record, "provenance": provenance})
