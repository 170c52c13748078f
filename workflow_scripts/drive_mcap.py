"""A drive folder, with scans, as an MCAP file."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.export.drive_mcap import write_mcap
from drivesplat.io.storage import no_provenance
from drivesplat.readers.drive.format import read_drive

with job(snakemake) as current:
    folder, scans = Path(current.input.drive).parent, next(iter(current.input.scans), None)  # a list of one, or of none
    rendered = read_drive(folder).rendered
    provenance = current.provenance(no_provenance() if rendered is None else rendered.provenance)
    write_mcap(folder, Path(current.output.mcap), None if scans is None else Path(scans), provenance)
