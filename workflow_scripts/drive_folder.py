"""checkpoint.npz, after an edit or along a trajectory, as a drive folder with nuScenes tables."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.editing.assets.library import digests_of, read_inserts
from drivesplat.editing.drive_folder import write_rendered_drive
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.settings.export import DriveJob

with job(snakemake, dataset=("sweeps",)) as current:
    scene = read_scene(current.input.scene)
    checkpoint = read_checkpoint(current.input.checkpoint)
    wildcards, settings = current.wildcards, current.settings(DriveJob)
    inserts = read_inserts(settings.edit, Path(current.input.checkpoint).parent)
    provenance = current.provenance(scene.provenance, checkpoint.provenance, inputs=digests_of(inserts))
    kind = {"edits": "edit", "trajectories": "trajectory"}[wildcards.kind]
    source = {"scene": wildcards.scene, "method": wildcards.method, kind: wildcards.drive}
    path = Path(current.output.drive)
    write_rendered_drive(scene, checkpoint, settings, current.device(), path, source, provenance, inserts)
