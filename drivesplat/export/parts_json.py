"""The groups of a model as PLYs of their own, with parts.json to say what each is and how it moves.

With them a drive can be put together again at any time, or otherwise: without a vehicle, with it elsewhere.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.export.names import distinct
from drivesplat.export.placement import placement
from drivesplat.export.sampled_motion import SampledMotion
from drivesplat.export.splat_ply import note_of, write_splat_ply
from drivesplat.export.trained_parts import SampledGroup, digests, middle_timestamp
from drivesplat.io.storage import write_json
from drivesplat.scene.scene import Scene

SCHEMA = 1
CONVENTIONS = {
    "world": "Metres, z up, the axes of the dataset's global frame; files of frame 'world' are in these coordinates.",
    "object": "Metres, x forward, y left, z up, the origin in the middle of the object's box; files of frame 'object' "
    "are in these coordinates, and their spherical harmonics want directions in them.",
    "transforms": "Matrices 4x4, row by row, applied to column vectors: world = object_to_world object.",
    "seconds": "Since the first image of any camera, whose timestamp is first_image.",
    "timestamps": "Microseconds of the dataset's clock: first_image plus the seconds.",
    "present": "From when to when the object is there, in seconds; at all other times it is absent.",
    "samples": "Thirty a second, at every image of cameras.json and at the annotations, while the object is there.",
    "colors": "Where colours vary with time they are those at colors_timestamp, the middle image's, "
    "which is also the time of splat.ply.",
    "size": "Length, width, height of the annotated box in metres; null, like category, where the scene "
    "knows no such track.",
}


def write_parts(path: str | Path, groups: Mapping[str, SampledGroup], scene: Scene, provenance: dict[str, Any]) -> None:
    """Writes every group as a PLY beside `path` and, once all are there, what they are to `path`.

    PLYs of groups that an earlier call left there and this one does not write are removed; other files stay.
    """
    folder = Path(path).parent
    files = {name: f"{stem}.ply" for name, stem in distinct(groups, _stem).items()}
    for name, group in groups.items():
        note = {"scene": scene.name, "piece": name, "frame": _frame(group), **digests(provenance)}
        write_splat_ply(folder / files[name], group.gaussians, note)
    _remove_others(folder, set(files.values()))
    write_json(path, {**_record(groups, files, scene), "provenance": provenance})


def _record(groups: Mapping[str, SampledGroup], files: Mapping[str, str], scene: Scene) -> dict[str, Any]:
    first_image = min(frame.timestamp for frame in scene.frames)
    return {
        **placement(scene, SCHEMA, CONVENTIONS),
        "first_image": first_image,
        "colors_timestamp": middle_timestamp(scene),
        "parts": [
            {
                "name": name,
                "file": files[name],
                "gaussians": len(group.gaussians),
                "sh_degree": group.gaussians.sh_degree,
                "frame": _frame(group),
                "category": group.track.category if group.track else None,
                "size": group.track.size.tolist() if group.track else None,
                "motion": _motion(group.motion, first_image) if group.motion else None,
            }
            for name, group in groups.items()
        ],
    }


def _motion(motion: SampledMotion, first_image: int) -> dict[str, Any]:
    return {
        "present": [list(span) for span in motion.spans],
        "seconds": motion.seconds.tolist(),
        "timestamps": (first_image + np.rint(motion.seconds * 1e6).astype(np.int64)).tolist(),
        "object_to_world": motion.object_to_world.tolist(),
    }


def _frame(group: SampledGroup) -> str:
    return "object" if group.motion else "world"


def _stem(name: str) -> str:
    """A name as that of a file, on any system."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", name) or "_"


def _remove_others(folder: Path, kept: set[str]) -> None:
    """Removes PLYs of groups that are not among the names `kept`."""
    for file in folder.glob("*.ply"):
        if file.name not in kept and "piece" in note_of(file):
            file.unlink()
