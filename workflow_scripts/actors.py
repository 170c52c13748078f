"""scene.json and own_car.json into actors.npz."""

import dataclasses

from drivesplat.workflow.job import job
from drivesplat.io.array_file import write_arrays
from drivesplat.preprocess.actor_seed import actors_record
from drivesplat.scene.ego_mask import read_ego_mask
from drivesplat.scene.scene import read_scene
from drivesplat.scene.track_references import refuse_fixed_tracks
from drivesplat.settings.actor_seed import ActorSeedJob

with job(snakemake, dataset=("images", "sweeps")) as current:
    scene, found = read_scene(current.input.scene), [read_ego_mask(path) for path in current.input.own_car]
    record = actors_record(scene, current.settings(ActorSeedJob), *(mask for mask, _ in found))
    refuse_fixed_tracks(current.track_references(), scene, [actor.id for actor in record.actors])
    provenance = current.provenance(scene.provenance, *(upstream for _, upstream in found))
    write_arrays(current.output.actors, dataclasses.replace(record, provenance=provenance))
