"""What results on synthetic worlds depend on, in a form that holds on every processor: digests of rounded streets,
shapes and textures, and coarse images that are compared with a tolerance.

`PYTHONPATH=.:tests python -m helpers.world_digests` writes those of the present code to DIGESTS.
"""

import hashlib
import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from drivesplat.settings.config import load
from drivesplat.settings.world import WorldJob
from drivesplat.workflow.stages import stage_settings
from drivesplat.world.optics.materials import facade, ground, surface
from drivesplat.world.recorder import Recorder, Viewpoint
from drivesplat.world.shapes.mesh import ColoredMesh, Material
from helpers import REPOSITORY
from helpers.demo_worlds import FRONT, LIDAR, recorder_of
from helpers.world_shapes import ALL, FIGURES, FURNITURE, PLANTS, VEHICLES

WORLDS = sorted(path.stem for path in (REPOSITORY / "benchmarks/worlds").glob("*.yaml"))
DIGESTS = Path(__file__).parents[1] / "world/world_digests.json"
FRACTIONS = np.array([0.0, 0.37, 1.0])
"""Of the drive: the times at which poses count."""
RESOLUTION = 1e-4
"""Metres; smaller differences, as between processors, give the same digest."""
OFFSET = 0.2718281828
"""In units of the resolution: no round number lies at the border of two rounded values."""
FOOTPRINTS = (0.002, 0.05, 0.6)
PICTURES = {
    "day": {"cyclists": 1, "bystanders": 2, "dogs": 1, "bend_deg": 20.0, "grade": 0.04, "samples_per_pixel": 4},
    "night": {"night": True, "wet": True, "readout_s": 0.03, "lidar": {"spins": True}, "traffic": "queue"},
}
"""Worlds whose recordings count, by the settings that differ from `helpers.demo_worlds.SMALL`."""
PICTURE_US = 2_000_000


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
                found.update(_rounded(mesh.vertices) + _faces(mesh))
    return found.hexdigest()


def shape_digests() -> dict[str, str]:
    """The sha256 of each group of shapes, with colours and textures; of figures, their poses over a walk, too."""
    groups = {"vehicles": VEHICLES, "plants": PLANTS, "furniture": FURNITURE}
    groups["others"] = ALL.keys() - {name for group in groups.values() for name in group}
    found = {group: b"".join(_mesh(ALL[name]()) for name in sorted(names)) for group, names in groups.items()}
    seconds = np.linspace(0.0, 3.0, 7)
    found["figures"] = b"".join(
        _rounded(figure.poses(1.3 * seconds, seconds)) + b"".join(map(_mesh, figure.pieces))
        for _, figure in sorted(FIGURES.items())
    )
    return {group: hashlib.sha256(content).hexdigest() for group, content in found.items()}


def texture_digests() -> dict[str, str]:
    """The sha256 of reflectances, mirror reflectances and emissions at places of the ground, walls and materials."""
    random = np.random.default_rng(0)
    places = random.uniform((-60.0, -15.0, 0.0), (120.0, 15.0, 12.0), (150, 3))
    normals = random.normal(size=(150, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = {"ground": [ground(x, y, size) for x, y, _ in places for size in FOOTPRINTS]}
    found["facade"] = [facade(0.34, 0.17, 0.11, x, z, size) for x, _, z in places for size in FOOTPRINTS]
    for kind in Material:
        found[kind.name.lower()] = [
            surface(int(kind), 0.3, 0.5, 0.2, *place, *normal, size)
            for place, normal in zip(places, normals, strict=True)
            for size in FOOTPRINTS
        ]
    return {name: hashlib.sha256(_rounded(np.array(values))).hexdigest() for name, values in found.items()}


def pictures(name: str) -> dict[str, list[int]]:
    """Of a world of PICTURES: means of the image's blocks of 12x9 pixels and three colours, the number of pixels of
    each class and of returns of each beam, the medians of the returns' ranges in centimetres, and their intensities."""
    recorder = recorder_of(**PICTURES[name])
    image, shown = recorder.image(FRONT, PICTURE_US), recorder.geometry(FRONT, PICTURE_US)
    blocks = image.reshape(6, 9, 8, 12, 3).mean(axis=(1, 3))
    scan = recorder.scan(LIDAR, PICTURE_US)
    ranges = [np.median(scan.measured[beam][scan.returned[beam]]) for beam in range(32)]
    return {
        "image": np.round(blocks).astype(int).ravel().tolist(),
        "classes": np.bincount(shown.classes.ravel(), minlength=16).tolist(),
        "returns": scan.returned.sum(axis=1).tolist(),
        "ranges": np.round(100 * np.array(ranges)).astype(int).tolist(),
        "intensities": np.round(1000 * (scan.intensity * scan.returned).mean(axis=1)).astype(int).tolist(),
    }


def _mesh(mesh: ColoredMesh) -> bytes:
    return _rounded(np.concatenate([mesh.vertices, mesh.texture])) + _rounded(mesh.color) + _faces(mesh)


def _faces(mesh: ColoredMesh) -> bytes:
    return np.concatenate([mesh.faces.ravel(), mesh.material, mesh.surface_class]).astype(np.int64).tobytes()


def _rounded(values: np.ndarray) -> bytes:
    return np.round(values / RESOLUTION + OFFSET).astype(np.int64).tobytes()


def present() -> dict:
    """All of them, of the present code."""
    return {
        "streets": {name: digest(recorder_of_world(name)) for name in WORLDS},
        "shapes": shape_digests(),
        "textures": texture_digests(),
        "pictures": {name: pictures(name) for name in PICTURES},
    }


if __name__ == "__main__":
    text = re.sub(r"\n +(?=-?\d|\])", " ", json.dumps(present(), indent=1))  # a list of numbers on one line
    DIGESTS.write_text(text + "\n")
    print(text)
