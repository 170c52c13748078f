"""parser.npz, masks/ and what the method needs of other stages' records into checkpoint.npz and train.json."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.settings.train import TrainJob
from drivesplat.training.stage import TrainingFiles, read_inputs, run_training

with job(snakemake, dataset=("images",)) as current:
    files = current.input
    of_scene = files.masks, files.actors, files.lidar_depth, files.scans
    wanted = ([*paths] for paths in (*of_scene, files.previous_parser, files.previous))
    inputs, upstream = read_inputs(files.parser, *wanted)
    made = TrainingFiles(Path(current.output.checkpoint), Path(current.output.summary))
    provenance = current.provenance(*upstream)
    run_training(inputs, current.settings(TrainJob), current.device(), made, provenance, current.name)
