"""Small synthetic worlds, and what stands in them."""

from copy import copy
from typing import Any

import numpy as np

from drivesplat.io.storage import canonical_json
from drivesplat.settings.edit import Edit
from drivesplat.settings.world import WorldJob, WorldSettings
from drivesplat.world.optics.rig import SENSORS
from drivesplat.world.recorder import Recorder
from drivesplat.world.street.objects import StreetObject

RIG = {sensor.channel: sensor for sensor in SENSORS}
FRONT, LIDAR = RIG["CAM_FRONT"], RIG["LIDAR_TOP"]
CAMERAS = tuple(channel for channel in RIG if channel != LIDAR.channel)
SENSOR_SETTINGS = frozenset({
    "width", "samples_per_pixel", "cameras", "sweeps", "image_hz", "lidar_hz", "readout_s", "pose_noise", "exposures",
    "night", "wet", "class_maps", "truth",
})  # fmt: skip
"""Settings that do not change the street; of `lidar`, all but `ego_returns`."""
STREETS_KEPT = 12
_recorders: dict[str, Recorder] = {}
"""A recorder of each street, by the settings of the street."""
SMALL: dict[str, Any] = {"width": 96, "samples_per_pixel": 1, "cameras": ("CAM_FRONT",)}


def world_of(**settings: Any) -> WorldSettings:
    """A world with small images of the front camera; `settings` override that."""
    return WorldSettings(**{**SMALL, **settings})


def job_of(world: WorldSettings, edits: dict[str, Edit] | None = None) -> WorldJob:
    return WorldJob(scene="demo", version="v1.0-mini", world=world, edits=edits or {})


def edit_of(*steps: dict) -> Edit:
    return Edit.model_validate({"steps": steps})


def recorder_of(edits: dict[str, Edit] | None = None, **settings: Any) -> Recorder:
    """The recorder of `world_of(**settings)`. Recorders of equal streets share the street and its ray caster."""
    world = world_of(**settings)
    key = canonical_json([world.model_dump(exclude={*SENSOR_SETTINGS, "lidar"}), world.lidar.ego_returns])
    if key not in _recorders:
        if len(_recorders) >= STREETS_KEPT:
            del _recorders[next(iter(_recorders))]
        _recorders[key] = Recorder(world)
    recorder = copy(_recorders[key])
    recorder.world, recorder.edits = world, dict(edits or {})
    if edits:
        recorder._variations, recorder._casters = {None: recorder.variation()}, {None: recorder._caster(None)}
    vars(recorder).pop("pattern", None)
    return recorder


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
