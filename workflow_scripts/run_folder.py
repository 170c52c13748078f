"""checkpoint.npz driven in again by a policy, as a drive folder."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.drive.trained_drive import open_drive
from drivesplat.editing.assets.library import digests_of, read_inserts
from drivesplat.io.storage import read_record
from drivesplat.settings.simulate import RunJob
from drivesplat.simulate.run_folder import write_run_drive

with job(snakemake) as current:
    wildcards, settings = current.wildcards, current.settings(RunJob)
    drive = open_drive(Path(current.input.checkpoint).parent, current.device())
    inserts = digests_of(read_inserts(settings.edit, drive.folder))
    provenance = current.provenance(drive.scene.provenance, drive.provenance, inputs=inserts)
    source = {"scene": wildcards.scene, "method": wildcards.method, "run": wildcards.run}
    record = read_record(current.input.record, "run", "episodes")
    write_run_drive(drive, settings, Path(current.output.drive), source, record, provenance)
