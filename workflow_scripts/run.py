"""checkpoint.npz driven in by a policy, into a record and a film."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.drive.trained_drive import open_drive
from drivesplat.editing.assets.asset import NO_INSERTS
from drivesplat.editing.assets.library import digests_of, read_inserts
from drivesplat.io.storage import write_json
from drivesplat.settings.simulate import RunJob
from drivesplat.simulate.run_stage import drive_runs

with job(snakemake) as current:
    settings = current.settings(RunJob)
    drive = open_drive(Path(current.input.checkpoint).parent, current.device())
    inserts = NO_INSERTS if settings.edit is None else read_inserts(settings.edit, drive.folder)
    provenance = current.provenance(drive.scene.provenance, drive.provenance, inputs=digests_of(inserts))
    record = drive_runs(drive, settings, Path(current.output.film))
    write_json(current.output.record, {**record, "provenance": provenance})
