"""The rule `demo_world`: a synthetic street in nuScenes format, with ground truth that recorded drives lack."""

import logging
import multiprocessing
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise, repeat
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from drivesplat.errors import ConfigError, ResultError
from drivesplat.io.storage import Provenance, atomic_write, canonical_json, sha256_text
from drivesplat.readers.truth import TruthView
from drivesplat.scene.images import write_png
from drivesplat.settings.world import WorldJob, WorldSettings
from drivesplat.world.marker import prepare_folder
from drivesplat.world.optics.raycast import NO_HIT, StreetRays
from drivesplat.world.optics.rig import RigSensor, image_height, key_frame_time, recording_sensors, trigger_times
from drivesplat.world.output.tables import NuScenesTables
from drivesplat.world.output.truth import (
    key_frames_of,
    planned,
    write_frame,
    write_scan,
    write_truth,
)  # fmt: skip
from drivesplat.world.recorder import STREET_TO_GLOBAL, Recorder, Viewpoint
from drivesplat.world.shapes.mesh import SurfaceClass

log = logging.getLogger(__name__)

START_US = 1_767_225_600_000_000
ANNOTATED_RANGE = 80.0
"""Objects farther from the ego vehicle than this (metres) have no box."""
JPEG_QUALITY = 95
SEMANTIC, SKY = "semantic", "sky"
"""Folders below the dataset's root."""
UNLABELLED = 255
JPEG_BYTES, TRUTH_BYTES, CLASS_BYTES = 0.45, 2.6, 0.06
"""Bytes per pixel: of an image, of all images of a true view, of the class and sky maps of an image."""
SWEEP_BYTES, SCAN_BYTES = 600_000, 250_000
"""Bytes of a sweep of 32 beams, and of its truth."""
CHECK_S = 0.1
"""Interval in seconds at which placed vehicles are checked."""
CLEARANCE = 0.25
"""Height above the ground (metres) of the lowest rays through a vehicle; curbs are lower."""


@dataclass(frozen=True)
class SensorFile:
    """An image or sweep to write. `path` is relative to the dataset's root; `time_us` counts from the drive's start."""

    sensor: RigSensor
    time_us: int
    is_key_frame: bool
    index: int
    token: str
    path: str


def make_world(root: Path, job: WorldJob, provenance: Provenance, workers: int = 1) -> None:
    """Writes the dataset below `root`: images, sweeps, truth/, class maps if asked for, and last the tables.

    The tables contain a digest of the provenance, so results are remade when the images are. Equal settings give equal
    bytes for any number of processes (`workers`). Raises ConfigError where `root` holds other files or an edit does not
    fit the street, ResultError where the disk is full or has no space for the world.
    """
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
    tables = NuScenesTables(job.scene, description, source, START_US, world)
    for index in range(world.key_frames):
        tables.add_sample(index, key_frame_time(world, index))
    files = []
    for sensor in recording_sensors(world):
        size = (world.width, image_height(world.width)) if sensor.is_camera else (0, 0)
        for time_us, is_key, index in trigger_times(sensor, world):
            row = tables.add_data(sensor, index, time_us, is_key, recorder.ego_to_global(time_us * 1e-6), size)
            files.append(SensorFile(sensor, time_us, is_key, index, *row))
    plans = planned(recorder)
    views, scans = ([plan for plan in plans if plan.sensor.is_camera == cameras] for cameras in (True, False))
    images = sum(file.sensor.is_camera for file in files)
    require_space(root, world_bytes(world, images, len(files) - images, len(views), len(scans)))
    with ProcessPoolExecutor(workers, context, _start_worker, (root, recorder)) as pool:
        counts = pool.map(_with_recorder, repeat(_write_file), files)
        visible = pool.map(_with_recorder, repeat(_visible_fractions), range(world.key_frames))
        frames = [
            pool.map(_with_recorder, repeat(write_frame), repeat(plan), key_frames_of(recorder, plan)) for plan in views
        ]
        sweeps = [pool.map(_with_recorder, repeat(write_scan), repeat(plan), range(world.key_frames)) for plan in scans]
        lidar = {f.index: n for f, n in zip(files, counts, strict=True) if n is not None and f.is_key_frame}
        for index, fractions in enumerate(visible):
            _annotate(tables, recorder, index, fractions, lidar[index])
        true_views = []
        for plan, found in zip(views, frames, strict=True):
            view = plan.viewpoint
            without = recorder.instance(view.without) if view.without else None
            true_views.append(TruthView(plan.sensor.channel, view.left, view.edit, without, tuple(found)))
        write_truth(root, recorder, true_views, [scan for found in sweeps for scan in found])
    tables.write(root, job.version)
    log.info("%d recordings, %d boxes in %s", len(files), len(tables.rows["sample_annotation"]), root)


def _annotate(
    tables: NuScenesTables, recorder: Recorder, index: int, visible: np.ndarray, lidar_points: np.ndarray
) -> None:
    """Adds the boxes of key frame `index`: objects in range that a camera or the LiDAR sees."""
    seconds = key_frame_time(recorder.world, index) * 1e-6
    ego = STREET_TO_GLOBAL @ recorder.ego_pose(seconds)
    for item, fraction, points in zip(recorder.objects, visible.tolist(), lidar_points.tolist(), strict=True):
        if item.category is None or not (fraction or points):
            continue
        box = recorder.box_to_global(item, seconds)
        if np.linalg.norm((box - ego)[:2, 3]) <= ANNOTATED_RANGE:
            tables.add_box(item.name, item.category, item.attribute, index, box, item.size, fraction, points)


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


def _write_file(root: Path, recorder: Recorder, file: SensorFile) -> np.ndarray | None:
    """Writes an image or a sweep. Returns the number of LiDAR returns per object, None for images."""
    with atomic_write(root / file.path) as target:
        if not file.sensor.is_camera:
            scan = recorder.scan(file.sensor, file.time_us)
            target.write(recorder.returns(scan, file.sensor, file.time_us).tobytes())
            return np.bincount(scan.object[scan.returned], minlength=len(recorder.objects))
        picture = recorder.picture(file.sensor, file.time_us)
        image = recorder.to_bytes(picture.radiance, file.sensor, file.time_us)
        Image.fromarray(image).save(target, "JPEG", quality=JPEG_QUALITY)
    if recorder.world.class_maps:
        # the sky is unlabelled in the class map: it has no Gaussians
        sky, name = picture.classes == SurfaceClass.SKY, f"{file.sensor.channel}/{PurePosixPath(file.path).stem}.png"
        write_png(root / SKY / name, np.where(sky, 255, 0).astype(np.uint8))
        write_png(root / SEMANTIC / name, np.where(sky, UNLABELLED, picture.classes).astype(np.uint8))
    return None


def _visible_fractions(root: Path, recorder: Recorder, index: int) -> np.ndarray:
    return recorder.visible_fractions(index)


def world_bytes(world: WorldSettings, images: int, sweeps: int, views: int, scans: int) -> int:
    """The approximate size in bytes of a world of so many images and sweeps, and of true views and scans, which are
    written for each key frame."""
    pixels, rays = world.width * image_height(world.width), world.lidar.beams / 32
    per_image = JPEG_BYTES + (CLASS_BYTES if world.class_maps else 0.0)
    recorded = images * pixels * per_image + sweeps * SWEEP_BYTES * rays
    return round(recorded + world.key_frames * (views * pixels * TRUTH_BYTES + scans * SCAN_BYTES * rays))


def require_space(root: Path, needed: int) -> None:
    """Raises ResultError, one line, where the file system of `root` has less free space than `needed` bytes."""
    free = shutil.disk_usage(root).free
    if needed > free:
        raise ResultError(
            f"{root}: the world takes about {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free; free some space, set "
            "another datasets.<name>.dataroot, or make the world smaller (width, key_frames, cameras)"
        )
