"""The eval.json of every method, and the baselines of LiDAR scans where there are any, into metrics.json."""

from drivesplat.workflow.job import job
from drivesplat.evaluation.scene_metrics import read_baselines, read_evaluations, side_by_side
from drivesplat.io.storage import write_json

with job(snakemake) as current:
    evals = read_evaluations(current.input.evals)
    baselines = [read_baselines(path) for path in current.input.baselines]
    provenance = current.provenance(*(record["provenance"] for record in (*evals.values(), *baselines)))
    write_json(current.output.metrics, {**side_by_side(evals, *baselines), "provenance": provenance})
