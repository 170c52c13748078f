"""splat.ply as splat.sog."""

from drivesplat.workflow.job import job
from drivesplat.export.compressed import export_sog

with job(snakemake) as current:
    export_sog(current.output.sog, current.input.splat)
