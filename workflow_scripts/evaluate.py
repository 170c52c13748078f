"""checkpoint.pt against held-out images, and against truth where there is any, into eval.json."""

from pathlib import Path

from drivesplat.evaluation.evaluate import EvaluationInputs, evaluate_method
from drivesplat.job import job
from drivesplat.masks import read_masks_record
from drivesplat.parser import read_parser
from drivesplat.scene import read_scene
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.storage import read_json, sha256_file, write_json
from drivesplat.training.run import read_checkpoint

with job(snakemake) as current:
    files, folder = current.input, Path(current.input.masks).parent
    parser, checkpoint, scene = read_parser(files.parser), read_checkpoint(files.checkpoint), read_scene(files.scene)
    record, summary = read_masks_record(folder), read_json(files.summary, rule="train")
    lpips = read_json(files.lpips[0], rule="lpips_backbone") if files.lpips else None
    truth = Path(files.truth[0]) if files.truth else None
    upstream = (parser["provenance"], record["provenance"], checkpoint["provenance"], scene.provenance)
    provenance = current.provenance(*upstream, inputs={"truth": sha256_file(truth)} if truth else {})
    inputs = EvaluationInputs(checkpoint, summary, parser, scene, folder, record, lpips, truth)
    result = evaluate_method(inputs, current.settings(EvaluateJob), current.device())
    write_json(current.output.metrics, {**result, "provenance": provenance})
