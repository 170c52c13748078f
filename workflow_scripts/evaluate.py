"""checkpoint.npz against held-out images, and against truth where there is any, into eval.json and a pair of images."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.evaluation.backbone import read_backbone
from drivesplat.evaluation.evaluate import EvaluationInputs, evaluate_method
from drivesplat.io.storage import sha256_file, write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.images import write_image
from drivesplat.scene.masks import read_masks_record
from drivesplat.scene.prepared_drive import read_prepared_drive
from drivesplat.scene.scan_record import read_scans
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.training.run import read_summary

with job(snakemake, dataset=("images", "sweeps")) as current:
    files, checkpoint = current.input, read_checkpoint(current.input.checkpoint)
    recording, upstream = read_prepared_drive(files.scene, files.parser, files.masks)
    record, summary = read_masks_record(recording.masks), read_summary(files.summary)
    lpips = read_backbone(files.lpips[0]) if files.lpips else None
    truth = Path(files.truth[0]) if files.truth else None
    scans = read_scans(files.scans[0]) if files.scans else None
    inputs = EvaluationInputs(checkpoint, summary, recording, record, lpips, truth, scans)
    digests = {"truth": sha256_file(truth)} if truth else {}
    upstream += [checkpoint.provenance] + ([scans.provenance] if scans else [])
    provenance = current.provenance(*upstream, inputs=digests)
    evaluation = evaluate_method(inputs, current.settings(EvaluateJob), current.device())
    write_image(current.output.recorded, evaluation.sample.recorded)
    write_image(current.output.rendered, evaluation.sample.rendered)
    write_json(current.output.metrics, {**evaluation.record, "provenance": provenance})
