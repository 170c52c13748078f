"""parser.pkl and masks/ into checkpoint.pt and train.json."""

from pathlib import Path

from drivesplat.job import job
from drivesplat.masks import read_masks_record
from drivesplat.parser import read_parser
from drivesplat.settings.train import TrainJob
from drivesplat.training.run import TrainingFiles, run_training

with job(snakemake) as current:
    parser = read_parser(current.input.parser)
    masks = Path(current.input.masks).parent
    provenance = current.provenance(parser["provenance"], read_masks_record(masks)["provenance"])
    files = TrainingFiles(Path(current.output.checkpoint), Path(current.output.summary), masks)
    run_training(parser, current.settings(TrainJob), current.device(), files, provenance, current.name)
