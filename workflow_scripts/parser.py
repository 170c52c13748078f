"""scene.json and seed.ply into parser.npz and parser.pkl."""

import dataclasses

from drivesplat.workflow.job import job
from drivesplat.io.point_cloud import read_ply
from drivesplat.preprocess.parser import training_record
from drivesplat.scene.scene import read_scene
from drivesplat.scene.training_record import write_training_pickle, write_training_record
from drivesplat.settings.images import ParserJob

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    seed = read_ply(current.input.seed[0], rule="lidar_seed") if current.input.seed else None
    record = training_record(scene, seed, current.settings(ParserJob))
    provenance = current.provenance(scene.provenance, *([seed.note["provenance"]] if seed else []))
    record = dataclasses.replace(record, provenance=provenance)
    write_training_record(current.output.parser, record)
    write_training_pickle(current.output.pickle, record)
