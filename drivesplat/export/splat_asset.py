"""The stage `export`: a trained model as splat.ply, and its rigid groups as one PLY each.

cameras.json has the recorded cameras, which place splat.ply in the world and in time; transforms.json has them as
nerfstudio reads them. parts.json has the attributes and
motions of the groups: other programs can compose the drive at any time, without a vehicle, or with a vehicle at another
place.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.export.camera_files import transforms_record
from drivesplat.export.trained_parts import SampledGroup, digests, shown_timestamp, trained_gaussians, trained_groups
from drivesplat.io.storage import Provenance, write_json
from drivesplat.io.unique_names import file_stems
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.model.gaussians import with_sh_degree
from drivesplat.model.splat_ply import note_of, write_splat_ply
from drivesplat.scene.scene import Scene
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.export import SplatJob

log = logging.getLogger(__name__)

SCHEMA = 1
GLOBAL = "A position in the dataset's global frame is its world position plus origin."
CAMERA_CONVENTIONS = {
    "world": "Metres, z up, the axes of the dataset's global frame; splat.ply is in these coordinates.",
    "camera": "OpenCV: x right, y down, z forward, metres; pinhole without distortion.",
    "ego": "The recording vehicle: x forward, y left, z up, on the ground under the rear axle.",
    "K": "Continuous pixels of an image of width x height: the image's corner is (0, 0), "
    "the first pixel's centre (0.5, 0.5).",
    "transforms": "Matrices 4x4, row by row, applied to column vectors: world = camera_to_world camera.",
    "timestamp": "Microseconds of the dataset's clock; each image has its own, and its poses are those at that time.",
    "sample_index": "The index of the image's key frame; for other images that of the nearest key frame in time.",
    "split": "The use of the image: train, held out for interpolation or extrapolation, "
    "or excluded because a held-out image is near.",
}
PART_CONVENTIONS = {
    "world": "Metres, z up, the axes of the dataset's global frame; files of frame 'world' are in these coordinates.",
    "object": "Metres, x forward, y left, z up, the origin at the centre of the object's box; files of frame 'object' "
    "are in these coordinates, and so are the directions of their spherical harmonics.",
    "transforms": "Matrices 4x4, row by row, applied to column vectors: world = object_to_world object.",
    "seconds": "Since the first image of any camera, whose timestamp is first_image.",
    "timestamps": "Microseconds of the dataset's clock: first_image plus the seconds.",
    "present": "Intervals in seconds in which the object is present; at all other times it is absent.",
    "samples": "Thirty a second, at every image of cameras.json and at the annotations, while the object is present.",
    "colors": "Colours that vary with time are those at colors_timestamp, which is also the time of splat.ply.",
    "deforms": "Whether the object's Gaussians move in its frame; their file has the shape at colors_timestamp.",
    "size": "Length, width, height of the annotated box in metres; null, like category, if the scene "
    "has no such track.",
}


@dataclass(frozen=True)
class SplatFiles:
    """The outputs of the stage; the PLYs of groups are written beside `parts`."""

    splat: str | Path
    cameras: str | Path
    parts: str | Path
    transforms: str | Path


def export_splat(
    files: SplatFiles,
    checkpoint: TrainedCheckpoint,
    record: TrainingRecord,
    scene: Scene,
    job: SplatJob,
    provenance: Provenance,
) -> None:
    """Writes all Gaussians of a checkpoint: together at the time that `job` shows, and group by group;
    and the recorded cameras. PLYs have spherical harmonics of at least `job.sh_degree`.

    PLY headers contain only the digests of `provenance`, since viewers limit their length; JSON files contain all.
    """
    model = trained_model(checkpoint)
    degree = job.sh_degree or 0
    gaussians = with_sh_degree(trained_gaussians(model, scene, job.time_s), degree)
    timestamps = np.array([frame.timestamp for frame in scene.frames])
    groups = {
        name: replace(group, gaussians=with_sh_degree(group.gaussians, degree))
        for name, group in trained_groups(model, scene, timestamps, job.time_s).items()
    }
    note = {"scene": scene.name, "origin": scene.origin.tolist(), **digests(provenance)}
    write_splat_ply(files.splat, gaussians, note)
    write_json(files.cameras, {**cameras_record(scene, record), "provenance": provenance})
    write_json(files.transforms, {**transforms_record(scene, record), "provenance": provenance})
    write_parts(files.parts, groups, scene, provenance, job.time_s)
    log.info("%d Gaussians, %d groups, %d images", len(gaussians), len(groups), len(scene.frames))


def cameras_record(scene: Scene, record: TrainingRecord) -> dict[str, Any]:
    """The images of a scene as plain data in the order of `scene.frames`, of which `record` is the training record.

    Poses and `origin` have full float64 precision; sizes and K are those of the training images.
    """
    split_of = {int(i): split for split, images in record.splits.items() for i in images}
    return {
        **_scene_header(scene, CAMERA_CONVENTIONS),
        "key_frame_timestamps": scene.key_frame_timestamps.tolist(),
        "images": [
            {
                "camera": frame.camera,
                "timestamp": frame.timestamp,
                "image": record.image_names[i],
                "width": record.image_size(i)[0],
                "height": record.image_size(i)[1],
                "K": record.Ks[i].tolist(),
                "camera_to_world": frame.camera_to_world.tolist(),
                "ego_to_world": frame.ego_to_world.tolist(),
                "is_key_frame": frame.is_key_frame,
                "sample_index": frame.sample_index,
                "split": split_of[i],
            }
            for i, frame in enumerate(scene.frames)
        ],
    }


def write_parts(
    path: str | Path,
    groups: Mapping[str, SampledGroup],
    scene: Scene,
    provenance: Provenance,
    time_s: float | None = None,
) -> None:
    """Writes every group as a PLY beside `path`, then their record to `path`. `time_s`: see `shown_timestamp`.

    PLYs of groups of earlier calls that are not written again are removed; other files stay.
    """
    folder, first_image = Path(path).parent, min(frame.timestamp for frame in scene.frames)
    files, parts = {name: f"{stem}.ply" for name, stem in file_stems(groups).items()}, []
    for name, group in groups.items():
        motion, frame, moves = group.motion, "object" if group.motion else "world", None
        note = {"scene": scene.name, "piece": name, "frame": frame, **digests(provenance)}
        write_splat_ply(folder / files[name], group.gaussians, note)
        if motion is not None:
            moves = {
                "present": [list(span) for span in motion.spans],
                "seconds": motion.seconds.tolist(),
                "timestamps": (first_image + np.rint(motion.seconds * 1e6).astype(np.int64)).tolist(),
                "object_to_world": motion.object_to_world.tolist(),
            }
        record = {
            "name": name,
            "file": files[name],
            "gaussians": len(group.gaussians),
            "sh_degree": group.gaussians.sh_degree,
            "frame": frame,
            "deforms": group.shapes is not None,
            "category": group.track.category if group.track else None,
            "size": group.track.size.tolist() if group.track else None,
            "motion": moves,
        }
        parts.append(record)
    for file in folder.glob("*.ply"):
        if file.name not in files.values() and "piece" in note_of(file):
            file.unlink()
    about = {"first_image": first_image, "colors_timestamp": shown_timestamp(scene, time_s), "parts": parts}
    write_json(path, {**_scene_header(scene, PART_CONVENTIONS), **about, "provenance": provenance})


def _scene_header(scene: Scene, conventions: Mapping[str, str]) -> dict[str, Any]:
    """The first entries of a record of `scene`; `origin` (3,) in metres, with full float64 precision."""
    return {
        "schema": SCHEMA,
        "scene": scene.name,
        "dataset": scene.dataset,
        "version": scene.version,
        "poses": scene.poses,
        "conventions": {"global": GLOBAL, **conventions},
        "origin": scene.origin.tolist(),
    }
