"""The eval.json of every method into metrics.json."""

from drivesplat.workflow.job import job
from drivesplat.evaluation.scene_metrics import read_evaluations, side_by_side
from drivesplat.io.storage import write_json

with job(snakemake) as current:
    evals = read_evaluations(current.input.evals)
    provenance = current.provenance(*(record["provenance"] for record in evals.values()))
    write_json(current.output.metrics, {**side_by_side(evals), "provenance": provenance})
