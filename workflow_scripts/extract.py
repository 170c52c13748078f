"""Tables into scene.json."""

import dataclasses
from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.preprocess.extract import extract_scene
from drivesplat.provenance.record import digests_of
from drivesplat.scene.scene import write_scene
from drivesplat.scene.track_references import refuse_unknown_tracks
from drivesplat.settings.extract import SceneSource

with job(snakemake) as current:
    tables, rows = current.input.tables, current.input.scene_tables
    root, of_scene = Path(snakemake.params.root), Path(rows[0]) if rows else None
    scene = extract_scene(current.settings(SceneSource), root, of_scene, Path(current.output.scene).parent)
    refuse_unknown_tracks(current.track_references(), scene)
    current.record_dataset(
        images=(frame.image_path for frame in scene.frames),
        sweeps=(sweep.path for sweep in scene.sweeps),
        classes=(frame.classes_path for frame in scene.frames if frame.classes_path),
    )
    provenance = current.provenance(inputs={"tables": digests_of([*tables, *rows])})
    write_scene(current.output.scene, dataclasses.replace(scene, provenance=provenance))
