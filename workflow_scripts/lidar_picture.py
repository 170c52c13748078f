"""checkpoint.npz at held-out LiDAR scans, into lidar.png."""

from drivesplat.workflow.job import job
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scan_record import read_scans
from drivesplat.scene.scene import read_scene
from drivesplat.visuals.figures import save_figure
from drivesplat.visuals.lidar_picture import draw_held_out_scans
from drivesplat.visuals.trained_lidar import open_trained_lidar

with job(snakemake) as current:
    scene, scans = read_scene(current.input.scene), read_scans(current.input.scans)
    lidar = open_trained_lidar(read_checkpoint(current.input.checkpoint), scene, scans, current.device())
    save_figure(current.output.picture, draw_held_out_scans(lidar, current.wildcards.method))
