"""checkpoint.npz as scene.alpasim.usdz: a scene for AlpaSim, with the drive itself."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.drive.trained_drive import open_drive
from drivesplat.export.alpasim import export_alpasim
from drivesplat.settings.export import AlpasimJob

with job(snakemake) as current:
    drive = open_drive(Path(current.input.checkpoint).parent, current.device())
    provenance = current.provenance(drive.scene.provenance, drive.provenance)
    export_alpasim(current.output.usdz, drive, current.settings(AlpasimJob), provenance)
