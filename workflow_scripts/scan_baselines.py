"""scans.npz into scan_baselines.json: held-out scans from training scans, without a model."""

from drivesplat.workflow.job import job
from drivesplat.evaluation.scan_baselines import baseline_record
from drivesplat.io.storage import write_json
from drivesplat.scene.scan_record import read_scans
from drivesplat.scene.scene import read_scene

with job(snakemake) as current:
    scene, scans = read_scene(current.input.scene), read_scans(current.input.scans)
    provenance = current.provenance(scene.provenance, scans.provenance)
    write_json(current.output.baselines, {**baseline_record(scene, scans), "provenance": provenance})
