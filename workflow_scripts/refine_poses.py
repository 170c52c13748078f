"""scene.json and own_car.json into scene_refined.json, poses.json and triangulated.npz."""

import dataclasses

from drivesplat.workflow.job import job
from drivesplat.io.array_file import write_arrays
from drivesplat.io.storage import write_json
from drivesplat.preprocess.poses.refinement import refine_or_keep
from drivesplat.scene.ego_mask import NO_EGO_MASK, read_ego_mask
from drivesplat.scene.scene import read_scene, write_scene
from drivesplat.settings.refine_poses import RefinePosesJob

with job(snakemake, dataset=("images", "sweeps")) as current:
    scene, found = read_scene(current.input.scene), [read_ego_mask(path) for path in current.input.own_car]
    ego_mask = found[0][0] if found else NO_EGO_MASK
    refinement = refine_or_keep(scene, current.settings(RefinePosesJob), ego_mask, current.threads)
    provenance = current.provenance(scene.provenance, *(upstream for _, upstream in found))
    write_json(current.output.poses, {**refinement.record, "provenance": provenance})
    write_arrays(current.output.points, dataclasses.replace(refinement.points, provenance=provenance))
    write_scene(current.output.scene, dataclasses.replace(refinement.scene, provenance=provenance))
