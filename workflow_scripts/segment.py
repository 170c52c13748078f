"""scene.json and the images into segmented/."""

import dataclasses
from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.preprocess.segmentation.maps import CACHE, make_maps, open_network
from drivesplat.scene.scene import read_scene
from drivesplat.settings.segment import SegmentJob

with job(snakemake, dataset=("images",)) as current:
    scene, settings = read_scene(current.input.scene), current.settings(SegmentJob)
    folder = Path(current.output.maps).parent
    network = open_network(settings, current.device())
    record = make_maps(scene, settings, network, folder, folder.parents[1] / CACHE)
    provenance = current.provenance(scene.provenance, inputs={"segment.model": network.digest})
    write_json(current.output.maps, vars(dataclasses.replace(record, provenance=provenance)))
