"""Digests of the streets of benchmarks/worlds/*.yaml: what results on these worlds depend on.

`PYTHONPATH=.:tests python -m helpers.world_digests` writes those of the present code to DIGESTS.
"""

import hashlib
import json
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from drivesplat.demo.recorder import Recorder, Viewpoint
from drivesplat.settings.config import load
from drivesplat.settings.world import WorldJob
from drivesplat.workflow.stages import stage_settings
from helpers import REPOSITORY

WORLDS = sorted(path.stem for path in (REPOSITORY / "benchmarks/worlds").glob("*.yaml"))
DIGESTS = Path(__file__).parents[1] / "demo/world_digests.json"
FRACTIONS = np.array([0.0, 0.37, 1.0])
"""Of the drive: the times at which poses count."""
RESOLUTION = 1e-4
"""Metres; smaller differences, as between processors, give the same digest."""


@cache
def job_of_world(name: str) -> WorldJob:
    """The settings of the rule `demo_world` for a named world."""
    config = load(yaml.safe_load((REPOSITORY / f"benchmarks/worlds/{name}.yaml").read_text()))
    return WorldJob.model_validate_json(stage_settings(config, "demo_world", name))


@cache
def recorder_of_world(name: str) -> Recorder:
    job = job_of_world(name)
    return Recorder(job.world, job.scene, job.edits)


def digest(recorder: Recorder) -> str:
    """The sha256 of meshes, classes and poses of all objects, of the drive and of its edits."""
    found, seconds = hashlib.sha256(), FRACTIONS * recorder.world.seconds
    for edit in (None, *recorder.edits):
        found.update(_rounded(recorder.ego_to_street(seconds, Viewpoint(edit=edit))))
        for item in recorder.variation(edit).street.objects:
            found.update(f"{item.name} {item.category} {item.attribute}".encode())
            found.update(_rounded(item.piece_poses(seconds)))
            for mesh in item.body.pieces:
                found.update(_rounded(mesh.vertices))
                found.update(np.concatenate([mesh.faces.ravel(), mesh.material, mesh.surface_class]).astype(np.int64))
    return found.hexdigest()


def _rounded(values: np.ndarray) -> bytes:
    return np.round(values / RESOLUTION).astype(np.int64).tobytes()


if __name__ == "__main__":
    digests = {name: digest(recorder_of_world(name)) for name in WORLDS}
    DIGESTS.write_text(json.dumps(digests, indent=1) + "\n")
    print(DIGESTS.read_text())
