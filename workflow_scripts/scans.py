"""scene.json into scans.npz."""

import dataclasses

from drivesplat.workflow.job import job
from drivesplat.io.array_file import write_arrays
from drivesplat.preprocess.scans import scan_records
from drivesplat.scene.scene import read_scene
from drivesplat.settings.scans import ScansJob

with job(snakemake, dataset=("sweeps",)) as current:
    scene = read_scene(current.input.scene)
    records = scan_records(scene, current.settings(ScansJob))
    write_arrays(current.output.scans, dataclasses.replace(records, provenance=current.provenance(scene.provenance)))
