"""checkpoint.npz against held-out images and scans, and against truth where there is any, into eval.json,
eval_objects.json and a pair of images."""

from drivesplat.workflow.job import job
from drivesplat.evaluation.evaluate import evaluate_method, read_evaluation_inputs
from drivesplat.io.storage import sha256_file, write_json
from drivesplat.scene.images import write_image
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.training.stage import read_summary

with job(snakemake, dataset=("images", "sweeps")) as current:
    files = current.input
    read = (files.scene, files.parser, files.masks, files.checkpoint, read_summary(files.summary))
    inputs, upstream = read_evaluation_inputs(*read, [*files.lpips], [*files.truth], [*files.scans])
    digests = {"truth": sha256_file(inputs.truth)} if inputs.truth else {}
    provenance = current.provenance(*upstream, inputs=digests)
    evaluation = evaluate_method(inputs, current.settings(EvaluateJob), current.device())
    write_image(current.output.recorded, evaluation.sample.recorded)
    write_image(current.output.rendered, evaluation.sample.rendered)
    write_json(current.output.metrics, {**evaluation.record, "provenance": provenance})
    write_json(current.output.objects, {**evaluation.objects, "provenance": provenance})
