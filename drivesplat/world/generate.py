"""The rule `demo_world`: a synthetic street in nuScenes format, with ground truth that recorded drives lack."""

import logging
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise, repeat
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import ConfigError
from drivesplat.io.storage import Provenance, canonical_json, sha256_text
from drivesplat.readers.truth import TruthView
from drivesplat.settings.world import WorldJob
from drivesplat.world.marker import prepare_folder
from drivesplat.world.optics.raycast import NO_HIT, StreetRays
from drivesplat.world.optics.rig import key_frame_time
from drivesplat.world.output.recordings import boxes, require_space, sensor_files, world_bytes, write_recording
from drivesplat.world.output.tables import NuScenesTables
from drivesplat.world.output.truth import (
    key_frames_of,
    planned,
    write_frame,
    write_scan,
    write_truth,
)  # fmt: skip
from drivesplat.world.recorder import Recorder, Viewpoint
from drivesplat.world.route.dataset import write_route

log = logging.getLogger(__name__)

CHECK_S = 0.1
"""Interval in seconds at which placed vehicles are checked."""
CLEARANCE = 0.25
"""Height above the ground (metres) of the lowest rays through a vehicle; curbs are lower."""


def make_world(root: Path, job: WorldJob, provenance: Provenance, workers: int = 1) -> None:
    """Writes the dataset below `root`: images, sweeps, truth/, class maps if asked for, and last the tables.

    The tables contain a digest of the provenance, so results are remade when the images are. Equal settings give equal
    bytes for any number of processes (`workers`). Raises ConfigError where `root` holds other files or an edit does not
    fit the street, ResultError where the disk is full or has no space for the world.
    """
    if job.world.route is not None:
        write_route(root, job, provenance, workers)
        return
    recorder = Recorder(job.world, job.scene, job.edits, job.donors)
    context = multiprocessing.get_context("fork")
    if any(step.place or step.insert for edit in job.edits.values() for step in edit.steps):
        with ProcessPoolExecutor(1, context) as pool:
            pool.submit(_check_places, job).result()
    prepare_folder(root, provenance)
    source = sha256_text(canonical_json(provenance["stages"]))
    world, light = job.world, "night" if job.world.night else "day"
    description = (
        f"Synthetic street, {light}, the ego vehicle {world.ego}, {world.traffic} traffic, {world.vehicles} moving "
        f"vehicles, {world.pedestrians} pedestrians"
    )
    tables = NuScenesTables(job.scene, description, source, world)
    for index in range(world.key_frames):
        tables.add_sample(index, key_frame_time(world, index))
    files = sensor_files(world, job.scene)
    for file in files:
        tables.add_data(file, recorder.ego_to_global(file.time_us * 1e-6))
    plans = planned(recorder)
    views, scans = ([plan for plan in plans if plan.sensor.is_camera == cameras] for cameras in (True, False))
    images = sum(file.sensor.is_camera for file in files)
    require_space(root, world_bytes(world, images, len(files) - images, len(views), len(scans)))
    with ProcessPoolExecutor(workers, context, _start_worker, (root, recorder)) as pool:
        counts = pool.map(_with_recorder, repeat(write_recording), files)
        visible = pool.map(_with_recorder, repeat(_visible_fractions), range(world.key_frames))
        frames = [
            pool.map(_with_recorder, repeat(write_frame), repeat(plan), key_frames_of(recorder, plan)) for plan in views
        ]
        sweeps = [pool.map(_with_recorder, repeat(write_scan), repeat(plan), range(world.key_frames)) for plan in scans]
        lidar = {f.index: n for f, n in zip(files, counts, strict=True) if n is not None and f.is_key_frame}
        for index, fractions in enumerate(visible):
            for box in boxes(recorder, index, fractions, lidar[index]):
                tables.add_box(box)
        true_views = []
        for plan, found in zip(views, frames, strict=True):
            view = plan.viewpoint
            without = recorder.instance(view.without) if view.without else None
            true_views.append(TruthView(plan.sensor.channel, view.left, view.edit, without, tuple(found)))
        write_truth(root, recorder, true_views, [scan for found in sweeps for scan in found])
    tables.write(root, job.version)
    log.info("%d recordings, %d boxes in %s", len(files), len(tables.rows["sample_annotation"]), root)


def require_free_places(recorder: Recorder) -> None:
    """Raises ConfigError, one line, where a placed or inserted object meets another during the drive."""
    for name, edit in recorder.edits.items():
        for number, step in enumerate(edit.steps, start=1):
            placed = step.place or step.insert
            if placed is None:
                continue
            met = first_contact(recorder, name, placed.name)
            if met is not None:
                raise ConfigError(
                    f"scene {recorder.scene}, edit {name!r}, step {number} ({step.kind}): {placed.name!r} is inside "
                    f"{met[1]} at {met[0]:.1f} s; choose another path"
                )


def first_contact(recorder: Recorder, edit: str, name: str) -> tuple[float, str] | None:
    """The first second at which the vehicle `name` of an edit touches an object, and that object's name; None if it
    touches none. Rays through its box find what is inside."""
    objects = recorder.variation(edit).street.objects
    placed = next((item for item in objects if item.name == name), None)
    if placed is None:  # a later step has removed it
        return None
    # lines through the vehicle's box, in its frame: its edges and diagonals at several heights
    length, width, height = placed.size
    corners = np.array([(x, y) for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]) * [length / 2, width / 2]
    pairs = [*pairwise([*corners, corners[0]]), (corners[0], corners[2]), (corners[1], corners[3])]
    heights = np.linspace(CLEARANCE, 0.95 * height, 4)
    starts = np.array([(*start, z) for start, _ in pairs for z in heights])
    ends = np.array([(*end, z) for _, end in pairs for z in heights])
    times = np.arange(0.0, recorder.world.seconds, CHECK_S)
    poses = np.repeat(placed.poses(times), len(starts), axis=0)
    start, toward = np.tile(starts, (len(times), 1)), np.tile(ends - starts, (len(times), 1))
    length = np.linalg.norm(toward, axis=1)
    origins = np.einsum("nij,nj->ni", poses[:, :3, :3], start) + poses[:, :3, 3]
    directions = np.einsum("nij,nj->ni", poses[:, :3, :3], toward / length[:, None])
    rays = StreetRays(np.repeat(times, len(starts)), origins, directions, np.arange(len(poses), dtype=np.int32))
    hits = recorder.snapshot(rays.seconds, Viewpoint(edit=edit, without=name)).cast(rays)
    inside = np.flatnonzero((hits.object != NO_HIT) & (hits.distance < length))
    if len(inside) == 0:
        return None
    return float(rays.seconds[inside[0]]), objects[int(hits.object[inside[0]])].name


_worker: tuple[Path, Recorder]
"""In a worker process: the dataset's root and the recorder."""


def _check_places(job: WorldJob) -> None:
    require_free_places(Recorder(job.world, job.scene, job.edits, job.donors))


def _start_worker(root: Path, recorder: Recorder) -> None:
    global _worker
    _worker = root, recorder


def _with_recorder(function: Callable[..., Any], *arguments: Any) -> Any:
    """In a worker process: calls a function with the root, the recorder and the arguments."""
    return function(*_worker, *arguments)


def _visible_fractions(root: Path, recorder: Recorder, index: int) -> np.ndarray:
    return recorder.visible_fractions(index)
