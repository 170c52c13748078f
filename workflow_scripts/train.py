"""parser.pkl, masks/ and what the method needs of actors.pkl and lidar_depth.pkl into checkpoint.pt and train.json."""

from pathlib import Path

from drivesplat.job import job
from drivesplat.settings.train import TrainJob
from drivesplat.training.run import TrainingFiles, read_inputs, run_training

with job(snakemake) as current:
    files = current.input
    inputs, upstream = read_inputs(files.parser, files.masks, [*files.actors], [*files.lidar_depth])
    made = TrainingFiles(Path(current.output.checkpoint), Path(current.output.summary))
    provenance = current.provenance(*upstream)
    run_training(inputs, current.settings(TrainJob), current.device(), made, provenance, current.name)
