"""checkpoint.pt against held-out images, into eval.json."""

from pathlib import Path

from drivesplat.evaluation.evaluate import evaluate_method
from drivesplat.job import job
from drivesplat.masks import read_masks_record
from drivesplat.parser import read_parser
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.storage import read_json, write_json
from drivesplat.training.run import read_checkpoint

with job(snakemake) as current:
    parser = read_parser(current.input.parser)
    checkpoint = read_checkpoint(current.input.checkpoint)
    masks = Path(current.input.masks).parent
    record, summary = read_masks_record(masks), read_json(current.input.summary, rule="train")
    lpips = read_json(current.input.lpips[0], rule="lpips_backbone") if current.input.lpips else None
    provenance = current.provenance(parser["provenance"], record["provenance"], checkpoint["provenance"])
    settings, device = current.settings(EvaluateJob), current.device()
    result = evaluate_method(checkpoint, summary, parser, masks, record, lpips, settings, device)
    write_json(current.output.metrics, {**result, "provenance": provenance})
