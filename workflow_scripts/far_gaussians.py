"""checkpoint.npz and its training views into far.npz: which Gaussians are too far away for exports."""

from drivesplat.workflow.job import job
from drivesplat.export.far_gaussians import find_far_in
from drivesplat.io.array_file import write_arrays
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.training_record import read_training_record
from drivesplat.settings.export import FarJob

with job(snakemake) as current:
    checkpoint, record = read_checkpoint(current.input.checkpoint), read_training_record(current.input.parser)
    provenance = current.provenance(checkpoint.provenance, record.provenance)
    limit = current.settings(FarJob).max_distance
    far = find_far_in(checkpoint, record, limit, provenance, current.device)
    write_arrays(current.output.far, far)
