"""The rule `demo_world`: a synthetic street in nuScenes format, with the truth that real logs lack beside it."""

import logging
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from drivesplat.demo.mark import begin
from drivesplat.demo.recorder import STREET_TO_GLOBAL, Recorder
from drivesplat.demo.rig import KEY_FRAME_US, SENSORS, Sensor, firing_times, height_of
from drivesplat.demo.tables import NuScenesTables
from drivesplat.demo.truth import write_truth, write_truth_frame
from drivesplat.io.storage import atomic_write, canonical_json, sha256_text
from drivesplat.readers.truth import TruthFrame
from drivesplat.settings.world import WorldJob, WorldSettings

log = logging.getLogger(__name__)

START_US = 1_767_225_600_000_000
ANNOTATED_RANGE = 80.0
"""Things further away than this (metres) from the own car carry no box."""
TRUTH_CAMERA = "CAM_FRONT"
JPEG_QUALITY = 95


@dataclass(frozen=True)
class RecordedFile:
    """One file to record: `path` relative to the dataset's root, `time_us` since the drive's start."""

    sensor: Sensor
    time_us: int
    is_key_frame: bool
    index: int
    token: str
    path: str


def make_world(root: Path, job: WorldJob, provenance: dict[str, Any], workers: int = 1) -> None:
    """Writes the dataset below `root`: tables, images, sweeps, and truth/. The tables come last.

    They name the provenance, so that what is made from them is remade whenever the images are. The same settings give
    the same bytes, whatever `workers`, the number of processes. Raises ConfigError where `root` holds other things,
    ResultError where the disk is full.
    """
    begin(root, provenance)
    world, recorder = job.world, Recorder(job.world)
    made_from = sha256_text(canonical_json(provenance["stages"]))
    tables = NuScenesTables(job.scene, _description(world), made_from, START_US, SENSORS, world.width)
    for index in range(world.key_frames):
        tables.sample(index, index * KEY_FRAME_US)
    recordings = [recording for sensor in SENSORS for recording in _recordings(tables, recorder, sensor)]
    with ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), _prepare, (world, root)) as pool:
        counts = pool.map(_record, recordings)
        visible = pool.map(_visible, range(world.key_frames))
        truths = pool.map(_truth, [r for r in recordings if r.sensor.channel == TRUTH_CAMERA and r.is_key_frame])
        lidar = {r.index: n for r, n in zip(recordings, counts, strict=True) if n is not None and r.is_key_frame}
        for index, fractions in enumerate(visible):
            _annotate(tables, recorder, index, fractions, lidar[index])
        write_truth(root, recorder, job.scene, TRUTH_CAMERA, list(truths))
    tables.write(root, job.version)
    log.info("%d recordings, %d boxes in %s", len(recordings), len(tables.rows["sample_annotation"]), root)


def _description(world: WorldSettings) -> str:
    light = "night" if world.night else "day"
    ego = "own car drives" if world.ego == "drives" else "own car stands"
    return f"Synthetic street, {light}, {ego}, {world.vehicles} moving vehicles, {world.pedestrians} pedestrians"


def _recordings(tables: NuScenesTables, recorder: Recorder, sensor: Sensor) -> list[RecordedFile]:
    world = recorder.world
    size = (world.width, height_of(world.width)) if sensor.is_camera else (0, 0)
    recordings = []
    for time_us, is_key, index in firing_times(sensor, world.key_frames, sensor.channel in world.sweeps):
        pose = recorder.ego_to_global(time_us * 1e-6)
        recordings.append(
            RecordedFile(sensor, time_us, is_key, index, *tables.data(sensor, index, time_us, is_key, pose, size))
        )
    return recordings


def _annotate(
    tables: NuScenesTables, recorder: Recorder, index: int, visible: np.ndarray, lidar_points: np.ndarray
) -> None:
    seconds = index * KEY_FRAME_US * 1e-6
    ego = STREET_TO_GLOBAL @ recorder.ego_to_street(seconds)
    for number, thing in enumerate(recorder.things):
        if thing.category is None or not (visible[number] or lidar_points[number]):
            continue
        box = recorder.box_to_global(thing, seconds)
        if np.linalg.norm((box - ego)[:2, 3]) <= ANNOTATED_RANGE:
            tables.annotation(
                thing.name, thing.category, thing.attribute, index, box, thing.body.size, float(visible[number]),
                int(lidar_points[number]),
            )  # fmt: skip


_at_work: tuple[Recorder, Path]
"""In a worker process: what it records, and where to."""


def _prepare(world: WorldSettings, root: Path) -> None:
    global _at_work
    _at_work = Recorder(world), root


def _record(recording: RecordedFile) -> np.ndarray | None:
    """Writes one file; how many LiDAR returns each thing got, None for images."""
    recorder, root = _at_work
    counts = None
    with atomic_write(root / recording.path) as file:
        if recording.sensor.is_camera:
            image = recorder.image(recording.sensor, recording.time_us)
            Image.fromarray(image).save(file, "JPEG", quality=JPEG_QUALITY)
        else:
            points, counts = recorder.sweep(recording.sensor, recording.time_us)
            file.write(points.tobytes())
    return counts


def _visible(index: int) -> np.ndarray:
    return _at_work[0].visible_fractions(index)


def _truth(recording: RecordedFile) -> TruthFrame:
    recorder, root = _at_work
    return write_truth_frame(root, recorder, recording.sensor, recording.index, recording.time_us, recording.token)
