"""LPIPS's backbone into resources/lpips, and a record of it."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.evaluation.backbone import provide_backbone
from drivesplat.io.storage import write_json
from drivesplat.settings.evaluate import BACKBONE, LpipsSettings

with job(snakemake) as current:
    backbone = Path(current.output.record).with_name(Path(BACKBONE).name)
    write_json(current.output.record, provide_backbone(current.settings(LpipsSettings), backbone))
