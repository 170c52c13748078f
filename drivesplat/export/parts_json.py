"""The rigid groups of a model as one PLY each, with parts.json for their attributes and motions.

They allow other programs to compose the drive at any time, without a vehicle, or with a vehicle at another place.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.export.sampled_motion import SampledMotion
from drivesplat.export.scene_header import scene_header
from drivesplat.export.splat_ply import note_of, write_splat_ply
from drivesplat.export.trained_parts import SampledGroup, digests, middle_timestamp
from drivesplat.export.unique_names import unique_names
from drivesplat.io.storage import Provenance, write_json
from drivesplat.scene.scene import Scene

SCHEMA = 1
CONVENTIONS = {
    "world": "Metres, z up, the axes of the dataset's global frame; files of frame 'world' are in these coordinates.",
    "object": "Metres, x forward, y left, z up, the origin at the centre of the object's box; files of frame 'object' "
    "are in these coordinates, and so are the directions of their spherical harmonics.",
    "transforms": "Matrices 4x4, row by row, applied to column vectors: world = object_to_world object.",
    "seconds": "Since the first image of any camera, whose timestamp is first_image.",
    "timestamps": "Microseconds of the dataset's clock: first_image plus the seconds.",
    "present": "Intervals in seconds in which the object is present; at all other times it is absent.",
    "samples": "Thirty a second, at every image of cameras.json and at the annotations, while the object is present.",
    "colors": "Colours that vary with time are those at colors_timestamp, the time of the middle image, "
    "which is also that of splat.ply.",
    "size": "Length, width, height of the annotated box in metres; null, like category, if the scene "
    "has no such track.",
}


def write_parts(path: str | Path, groups: Mapping[str, SampledGroup], scene: Scene, provenance: Provenance) -> None:
    """Writes every group as a PLY beside `path`, then their record to `path`.

    PLYs of groups of earlier calls that are not written again are removed; other files stay.
    """
    folder = Path(path).parent
    files = {name: f"{stem}.ply" for name, stem in unique_names(groups, _stem).items()}
    for name, group in groups.items():
        note = {"scene": scene.name, "piece": name, "frame": _frame(group), **digests(provenance)}
        write_splat_ply(folder / files[name], group.gaussians, note)
    _remove_others(folder, set(files.values()))
    write_json(path, {**_record(groups, files, scene), "provenance": provenance})


def _record(groups: Mapping[str, SampledGroup], files: Mapping[str, str], scene: Scene) -> dict[str, Any]:
    first_image = min(frame.timestamp for frame in scene.frames)
    return {
        **scene_header(scene, SCHEMA, CONVENTIONS),
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
    """A name as a file name that is valid on every system."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", name) or "_"


def _remove_others(folder: Path, kept: set[str]) -> None:
    """Removes PLYs of groups whose file names are not in `kept`."""
    for file in folder.glob("*.ply"):
        if file.name not in kept and "piece" in note_of(file):
            file.unlink()
