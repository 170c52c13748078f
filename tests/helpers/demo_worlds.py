"""Small synthetic worlds, and what stands in them."""

from typing import Any

import numpy as np

from drivesplat.demo.optics.rig import SENSORS
from drivesplat.demo.recorder import Recorder
from drivesplat.demo.street.objects import StreetObject
from drivesplat.settings.edit import Edit
from drivesplat.settings.world import WorldJob, WorldSettings

RIG = {sensor.channel: sensor for sensor in SENSORS}
FRONT, LIDAR = RIG["CAM_FRONT"], RIG["LIDAR_TOP"]
CAMERAS = tuple(channel for channel in RIG if channel != LIDAR.channel)
SMALL: dict[str, Any] = {"width": 96, "samples_per_pixel": 1, "cameras": ("CAM_FRONT",)}


def world_of(**settings: Any) -> WorldSettings:
    """A world with small images of the front camera; `settings` override that."""
    return WorldSettings(**{**SMALL, **settings})


def job_of(world: WorldSettings, edits: dict[str, Edit] | None = None) -> WorldJob:
    return WorldJob(scene="demo", version="v1.0-mini", world=world, edits=edits or {})


def edit_of(*steps: dict) -> Edit:
    return Edit.model_validate({"steps": steps})


def recorder_of(edits: dict[str, Edit] | None = None, **settings: Any) -> Recorder:
    """The recorder of `world_of(**settings)`."""
    return Recorder(world_of(**settings), edits=edits)


def names_of(recorder: Recorder, edit: str | None = None) -> list[str]:
    """The names of the objects, at their indices."""
    return [item.name for item in recorder.variation(edit).street.objects]


def named(recorder: Recorder, name: str, edit: str | None = None) -> StreetObject:
    """The object of that name."""
    return recorder.variation(edit).street.objects[names_of(recorder, edit).index(name)]


def pose_at(item: StreetObject, seconds: float) -> np.ndarray:
    """Object to street (4, 4)."""
    return item.poses(np.array([seconds]))[0]


def meshes_at(item: StreetObject, seconds: float) -> np.ndarray:
    """Corners (f, 3, 3) of all triangles of an object in the street frame."""
    poses = item.piece_poses(np.array([seconds]))[0]
    pieces = zip(poses, item.body.pieces, strict=True)
    return np.concatenate([mesh.triangles @ pose[:3, :3].T + pose[:3, 3] for pose, mesh in pieces])
