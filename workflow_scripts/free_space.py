"""scene.json, and triangulated.pkl where poses are refined, into free_space.pkl."""

from drivesplat.workflow.job import job
from drivesplat.io.plain_pickle import write_plain_pickle
from drivesplat.poses.triangulated import read_triangulated
from drivesplat.preprocess.free_space import free_space_record
from drivesplat.scene.scene import read_scene
from drivesplat.settings.free_space import FreeSpaceJob

with job(snakemake, dataset=("sweeps",)) as current:
    scene = read_scene(current.input.scene)
    triangulated = read_triangulated(current.input.triangulated[0]) if current.input.triangulated else None
    record = free_space_record(scene, current.settings(FreeSpaceJob), triangulated)
    write_plain_pickle(current.output.free_space, {**record, "provenance": current.provenance(scene.provenance)})
