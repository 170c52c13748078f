"""scene.json and, where the tracks are discovered, discovered.json into the scene.json of other tracks."""

import dataclasses

from drivesplat.workflow.job import job
from drivesplat.lidar.objects.record import read_discovered
from drivesplat.scene.scene import read_scene, write_scene
from drivesplat.scene.track_references import refuse_unknown_tracks

with job(snakemake) as current:
    scene, found = read_scene(current.input.scene), [read_discovered(path) for path in current.input.discovered]
    tracks = tuple(track for record in found for track in record.tracks)
    provenance = current.provenance(scene.provenance, *(record.provenance for record in found))
    relabelled = dataclasses.replace(scene, tracks=tracks, provenance=provenance)
    refuse_unknown_tracks(current.track_references(), relabelled)
    write_scene(current.output.scene, relabelled)
