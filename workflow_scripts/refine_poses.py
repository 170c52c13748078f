"""scene.json into scene_refined.json, poses.json and triangulated.pkl."""

import dataclasses

from drivesplat.job import job
from drivesplat.poses.refine import refine_poses
from drivesplat.scene import read_scene, write_scene
from drivesplat.settings.refine_poses import RefinePosesJob
from drivesplat.storage import write_json, write_plain_pickle

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    refinement = refine_poses(scene, current.settings(RefinePosesJob), current.threads)
    provenance = current.provenance(scene.provenance)
    write_json(current.output.poses, {**refinement.record, "provenance": provenance})
    write_plain_pickle(current.output.points, {**refinement.points, "provenance": provenance})
    write_scene(current.output.scene, dataclasses.replace(refinement.scene, provenance=provenance))
