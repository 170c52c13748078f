"""The light of a scene, from its training images."""

import logging

from drivesplat.workflow.job import job
from drivesplat.preprocess.light import estimate_light
from drivesplat.scene.light import write_light
from drivesplat.scene.scene import read_scene
from drivesplat.settings.images import LightJob

with job(snakemake, dataset=("images",)) as current:
    scene = read_scene(current.input.scene)
    light = estimate_light(scene, current.settings(LightJob))
    logging.getLogger(__name__).info("%s", light.in_words)
    write_light(current.output.light, light, current.provenance(scene.provenance))
