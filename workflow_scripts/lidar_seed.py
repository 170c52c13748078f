"""scene.json into seed.ply."""

import dataclasses

from drivesplat.job import job
from drivesplat.point_cloud import write_ply
from drivesplat.poses.triangulated import read_triangulated
from drivesplat.provenance import digests_of
from drivesplat.scene import read_scene
from drivesplat.seeding.seed import seed_points
from drivesplat.settings.lidar_seed import SeedJob

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    triangulated = read_triangulated(current.input.triangulated[0]) if current.input.triangulated else None
    points = seed_points(scene, current.settings(SeedJob), triangulated)
    extra = {"points_file": digests_of(current.input.points_file)} if current.input.points_file else {}
    note = {**points.note, "provenance": current.provenance(scene.provenance, inputs=extra)}
    write_ply(current.output.seed, dataclasses.replace(points, note=note))
