"""checkpoint.npz, after an edit or along a trajectory, as LiDAR scans."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.editing.assets.library import digests_of, read_inserts
from drivesplat.editing.scan_folder import write_scan_folder
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scan_record import read_scans
from drivesplat.scene.scene import read_scene
from drivesplat.settings.export import ScanFolderJob

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    checkpoint, records = read_checkpoint(current.input.checkpoint), read_scans(current.input.scans)
    wildcards, settings = current.wildcards, current.settings(ScanFolderJob)
    inserts = read_inserts(settings.edit, Path(current.input.checkpoint).parent)
    upstream = scene.provenance, checkpoint.provenance, records.provenance
    provenance = current.provenance(*upstream, inputs=digests_of(inserts))
    kind = {"edits": "edit", "trajectories": "trajectory"}[wildcards.kind]
    source = {"scene": wildcards.scene, "method": wildcards.method, kind: wildcards.drive}
    path = Path(current.output.scans)
    write_scan_folder(scene, checkpoint, records, settings, current.device(), path, source, provenance, inserts)
