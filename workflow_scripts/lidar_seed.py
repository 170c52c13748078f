"""scene.json and own_car.json into seed.ply."""

import dataclasses

from drivesplat.workflow.job import job
from drivesplat.io.point_cloud import write_ply
from drivesplat.preprocess.lidar_seed import seed_points
from drivesplat.preprocess.poses.triangulated import read_triangulated
from drivesplat.provenance.record import digests_of
from drivesplat.scene.ego_mask import read_ego_mask
from drivesplat.scene.scene import read_scene
from drivesplat.settings.lidar_seed import SeedJob

with job(snakemake, dataset=("images", "sweeps")) as current:
    scene, (ego_mask, upstream) = read_scene(current.input.scene), read_ego_mask(current.input.own_car)
    triangulated = read_triangulated(current.input.triangulated[0]) if current.input.triangulated else None
    points = seed_points(scene, current.settings(SeedJob), ego_mask, triangulated)
    extra = {"points_file": digests_of(current.input.points_file)} if current.input.points_file else {}
    note = {**points.note, "provenance": current.provenance(scene.provenance, upstream, inputs=extra)}
    write_ply(current.output.seed, dataclasses.replace(points, note=note))
