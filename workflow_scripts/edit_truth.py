"""checkpoint.npz after an edit against the truth of a synthetic world, into figures and a picture."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.editing.assets.library import digests_of, read_inserts
from drivesplat.evaluation.synthetic import DriveTruth
from drivesplat.io.storage import sha256_file, write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.evaluation_data import read_evaluation_data
from drivesplat.scene.images import write_png
from drivesplat.scene.scan_record import read_scans
from drivesplat.settings.render import EditJob
from drivesplat.visuals.edit_truth import measure_edit

with job(snakemake, dataset=("images",)) as current:
    files, wildcards, settings = current.input, current.wildcards, current.settings(EditJob)
    recording, upstream = read_evaluation_data(files.scene, files.parser, files.masks)
    checkpoint, known = read_checkpoint(files.checkpoint), DriveTruth.read(files.truth[0], recording)
    inserts = read_inserts(settings.edit, Path(files.checkpoint).parent)
    inputs = {"truth": sha256_file(known.path), **digests_of(inserts)}
    scans = next(map(read_scans, files.scans), None)
    of_scans = () if scans is None else (scans.provenance,)
    provenance = current.provenance(*upstream, checkpoint.provenance, *of_scans, inputs=inputs)
    record, picture = measure_edit(checkpoint, known, settings, wildcards.edit, inserts, current.device(), scans)
    write_png(current.output.picture, picture)
    write_json(current.output.figures, {**record, "provenance": provenance})
