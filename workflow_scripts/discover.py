"""scene.json and scans.npz into discovered.json."""

import dataclasses

from drivesplat.workflow.job import job
from drivesplat.lidar.objects.record import write_discovered
from drivesplat.lidar.objects.tracks import discovered_tracks
from drivesplat.scene.scan_record import read_scans
from drivesplat.scene.scene import read_scene
from drivesplat.settings.discover import DiscoverJob

with job(snakemake) as current:
    scene, records = read_scene(current.input.scene), read_scans(current.input.scans)
    found = discovered_tracks(scene, records, current.settings(DiscoverJob).discover, current.threads)
    provenance = current.provenance(scene.provenance, records.provenance)
    write_discovered(current.output.tracks, dataclasses.replace(found, provenance=provenance))
