"""scene.json, and triangulated.npz where poses are refined, into free_space.npz."""

import dataclasses

from drivesplat.workflow.job import job
from drivesplat.io.array_file import write_arrays
from drivesplat.poses.triangulated import read_triangulated
from drivesplat.preprocess.free_space import free_space_record
from drivesplat.scene.scene import read_scene
from drivesplat.settings.free_space import FreeSpaceJob

with job(snakemake, dataset=("sweeps",)) as current:
    scene = read_scene(current.input.scene)
    triangulated = read_triangulated(current.input.triangulated[0]) if current.input.triangulated else None
    record = free_space_record(scene, current.settings(FreeSpaceJob), triangulated)
    provenance = current.provenance(scene.provenance)
    write_arrays(current.output.free_space, dataclasses.replace(record, provenance=provenance))
