"""checkpoint.npz against the held-out scans of a scene without cameras, into eval.json."""

from drivesplat.workflow.job import job
from drivesplat.evaluation.evaluate_scans import evaluate_scans, read_scan_evaluation_inputs
from drivesplat.io.storage import write_json
from drivesplat.settings.evaluate import EvaluateScansJob
from drivesplat.training.stage import read_summary

with job(snakemake, dataset=("sweeps",)) as current:
    files = current.input
    inputs, upstream = read_scan_evaluation_inputs(
        files.scene, files.parser, files.checkpoint, read_summary(files.summary), files.scans
    )
    evaluation = evaluate_scans(inputs, current.settings(EvaluateScansJob), current.device())
    write_json(current.output.metrics, {**evaluation, "provenance": current.provenance(*upstream)})
