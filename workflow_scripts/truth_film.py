"""checkpoint.npz from beside the recorded path and the truth of a synthetic world, into truth.mp4 and truth.json."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.evaluation.synthetic import DriveTruth
from drivesplat.io.storage import sha256_file, write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.evaluation_data import read_evaluation_data
from drivesplat.settings.render import TruthFilmJob
from drivesplat.visuals.truth_film import render_truth_film

with job(snakemake, dataset=("images",)) as current:
    files, settings = current.input, current.settings(TruthFilmJob)
    recording, upstream = read_evaluation_data(files.scene, files.parser, files.masks)
    checkpoint, known = read_checkpoint(files.checkpoint), DriveTruth.read(files.truth[0], recording)
    provenance = current.provenance(*upstream, checkpoint.provenance, inputs={"truth": sha256_file(known.path)})
    film, method = Path(current.output.film), current.wildcards.method
    record = render_truth_film(checkpoint, known, method, settings, current.device(), film)
    write_json(current.output.figures, {**record, "provenance": provenance})
