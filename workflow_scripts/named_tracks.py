"""scene.json and the tracks that settings name, into named_tracks.json."""

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.preprocess.named_tracks import check_named_tracks
from drivesplat.scene.scene import read_scene
from drivesplat.settings.named_tracks import NamedTracks

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    record = check_named_tracks(scene, current.settings(NamedTracks))
    write_json(current.output.record, {**record, "provenance": current.provenance(scene.provenance)})
