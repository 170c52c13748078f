"""checkpoint.npz at all LiDAR scans of the drive, into lidar.mp4 and the figures of each scan."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scan_record import read_scans
from drivesplat.scene.scene import read_scene
from drivesplat.settings.render import LidarFilmJob
from drivesplat.visuals.lidar_film import render_lidar_film
from drivesplat.visuals.trained_lidar import open_trained_lidar

with job(snakemake) as current:
    scene, scans = read_scene(current.input.scene), read_scans(current.input.scans)
    checkpoint = read_checkpoint(current.input.checkpoint)
    provenance = current.provenance(scene.provenance, scans.provenance, checkpoint.provenance)
    lidar, settings = open_trained_lidar(checkpoint, scene, scans, current.device()), current.settings(LidarFilmJob)
    record = render_lidar_film(lidar, current.wildcards.method, settings, Path(current.output.film))
    write_json(current.output.figures, {**record, "provenance": provenance})
