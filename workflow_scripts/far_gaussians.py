"""checkpoint.npz and its training views into far.npz: which Gaussians are too far away for exports."""

from drivesplat.workflow.job import job
from drivesplat.export.far_gaussians import find_far, write_far
from drivesplat.model.checkpoint import open_model, read_checkpoint
from drivesplat.model.view import view_of
from drivesplat.scene.training_record import read_training_record
from drivesplat.settings.export import FarJob

with job(snakemake) as current:
    checkpoint, record = read_checkpoint(current.input.checkpoint), read_training_record(current.input.parser)
    provenance = current.provenance(checkpoint.provenance, record.provenance)
    model, device = open_model(checkpoint, current.device())
    views = [view_of(record, index, device) for index in record.train_images]
    far = find_far(model, views, current.settings(FarJob).max_distance, provenance)
    write_far(current.output.far, far)
