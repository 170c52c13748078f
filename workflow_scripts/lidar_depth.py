"""scene.json into lidar_depth.pkl."""

from drivesplat.job import job
from drivesplat.scene import read_scene
from drivesplat.seeding.depth_points import lidar_depths
from drivesplat.settings.lidar_depth import LidarDepthJob
from drivesplat.storage import write_plain_pickle

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    images = lidar_depths(scene, current.settings(LidarDepthJob))
    write_plain_pickle(current.output.depth, {"images": images, "provenance": current.provenance(scene.provenance)})
