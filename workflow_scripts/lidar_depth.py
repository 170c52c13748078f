"""scene.json and own_car.json into lidar_depth.npz."""

from drivesplat.workflow.job import job
from drivesplat.io.array_file import write_arrays
from drivesplat.lidar.depth_record import LidarDepthRecord
from drivesplat.preprocess.lidar_depth import lidar_depths
from drivesplat.scene.ego_mask import read_ego_mask
from drivesplat.scene.scene import read_scene
from drivesplat.settings.lidar_depth import LidarDepthJob

with job(snakemake, dataset=("sweeps",)) as current:
    scene, (ego_mask, upstream) = read_scene(current.input.scene), read_ego_mask(current.input.own_car)
    images = lidar_depths(scene, current.settings(LidarDepthJob), ego_mask)
    provenance = current.provenance(scene.provenance, upstream)
    write_arrays(current.output.depth, LidarDepthRecord(images, provenance))
