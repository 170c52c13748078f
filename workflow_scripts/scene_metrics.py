"""The eval.json of every method into metrics.json."""

from pathlib import Path

from drivesplat.evaluation.scene_metrics import side_by_side
from drivesplat.job import job
from drivesplat.storage import read_json, write_json

with job(snakemake) as current:
    evals = {Path(path).parent.name: read_json(path, rule="evaluate") for path in current.input.evals}
    provenance = current.provenance(*(record["provenance"] for record in evals.values()))
    write_json(current.output.metrics, {**side_by_side(evals), "provenance": provenance})
