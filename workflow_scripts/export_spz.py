"""splat.ply as splat.spz."""

from drivesplat.workflow.job import job
from drivesplat.export.compressed import export_spz

with job(snakemake) as current:
    export_spz(current.output.spz, current.input.splat)
