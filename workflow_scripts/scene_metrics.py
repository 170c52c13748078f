"""The eval.json of every method and, where there are any, the baselines of LiDAR scans and the quality of discovered
tracks, into metrics.json."""

from drivesplat.workflow.job import job
from drivesplat.evaluation.scene_metrics import read_baselines, read_evaluations, side_by_side
from drivesplat.io.storage import write_json
from drivesplat.lidar.objects.record import read_discovered

with job(snakemake) as current:
    evals = read_evaluations(current.input.evals)
    baselines = next((read_baselines(path) for path in current.input.baselines), None)
    found = next((read_discovered(path) for path in current.input.discovered), None)
    upstream = [record["provenance"] for record in (*evals.values(), *([baselines] if baselines else []))]
    provenance = current.provenance(*upstream, *([found.provenance] if found else []))
    metrics = side_by_side(evals, baselines, found.quality if found else None)
    write_json(current.output.metrics, {**metrics, "provenance": provenance})
