"""checkpoint.npz of all methods at the recorded images, into compare.mp4 and the figures of each image."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.evaluation_data import read_evaluation_data
from drivesplat.settings.render import CompareJob
from drivesplat.visuals.compare import render_comparison

with job(snakemake, dataset=("images",)) as current:
    files = current.input
    recording, upstream = read_evaluation_data(files.scene, files.parser, files.masks)
    checkpoints = {Path(file).parent.name: read_checkpoint(file) for file in files.checkpoints}
    provenance = current.provenance(*upstream, *(one.provenance for one in checkpoints.values()))
    record = render_comparison(
        checkpoints, recording, current.settings(CompareJob), current.device(), Path(current.output.film)
    )
    write_json(current.output.figures, {**record, "provenance": provenance})
