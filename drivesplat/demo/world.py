"""The rule `demo_world`: a synthetic street in nuScenes format, with ground truth that recorded drives lack."""

import logging
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from drivesplat.demo.marker import prepare_folder
from drivesplat.demo.recorder import STREET_TO_GLOBAL, Recorder
from drivesplat.demo.rig import KEY_FRAME_US, SENSORS, DemoSensor, image_height, trigger_times
from drivesplat.demo.tables import NuScenesTables
from drivesplat.demo.truth import write_truth, write_truth_frame
from drivesplat.io.storage import Provenance, atomic_write, canonical_json, sha256_text
from drivesplat.readers.truth import TruthFrame
from drivesplat.settings.world import WorldJob, WorldSettings

log = logging.getLogger(__name__)

START_US = 1_767_225_600_000_000
ANNOTATED_RANGE = 80.0
"""Objects farther from the ego vehicle than this (metres) have no box."""
TRUTH_CAMERA = "CAM_FRONT"
JPEG_QUALITY = 95


@dataclass(frozen=True)
class SensorFile:
    """An image or sweep to write. `path` is relative to the dataset's root; `time_us` counts from the drive's start."""

    sensor: DemoSensor
    time_us: int
    is_key_frame: bool
    index: int
    token: str
    path: str


def make_world(root: Path, job: WorldJob, provenance: Provenance, workers: int = 1) -> None:
    """Writes the dataset below `root`: images, sweeps, truth/, and last the tables.

    The tables contain a digest of the provenance, so results are remade when the images are. Equal settings give equal
    bytes for any number of processes (`workers`). Raises ConfigError where `root` holds other files, ResultError where
    the disk is full.
    """
    prepare_folder(root, provenance)
    world, recorder = job.world, Recorder(job.world)
    source = sha256_text(canonical_json(provenance["stages"]))
    tables = NuScenesTables(job.scene, _description(world), source, START_US, SENSORS, world.width)
    for index in range(world.key_frames):
        tables.add_sample(index, index * KEY_FRAME_US)
    files = [file for sensor in SENSORS for file in _sensor_files(tables, recorder, sensor)]
    with ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), _start_worker, (world, root)) as pool:
        counts = pool.map(_write_file, files)
        visible = pool.map(_visible_fractions, range(world.key_frames))
        truths = pool.map(_write_truth, [f for f in files if f.sensor.channel == TRUTH_CAMERA and f.is_key_frame])
        lidar = {f.index: n for f, n in zip(files, counts, strict=True) if n is not None and f.is_key_frame}
        for index, fractions in enumerate(visible):
            _annotate(tables, recorder, index, fractions, lidar[index])
        write_truth(root, recorder, job.scene, TRUTH_CAMERA, list(truths))
    tables.write(root, job.version)
    log.info("%d recordings, %d boxes in %s", len(files), len(tables.rows["sample_annotation"]), root)


def _description(world: WorldSettings) -> str:
    light = "night" if world.night else "day"
    return (
        f"Synthetic street, {light}, own car {world.ego}, {world.vehicles} moving vehicles, "
        f"{world.pedestrians} pedestrians"
    )


def _sensor_files(tables: NuScenesTables, recorder: Recorder, sensor: DemoSensor) -> list[SensorFile]:
    """Adds the recordings of a sensor to the tables."""
    world = recorder.world
    size = (world.width, image_height(world.width)) if sensor.is_camera else (0, 0)
    files = []
    for time_us, is_key, index in trigger_times(sensor, world.key_frames, sensor.channel in world.sweeps):
        pose = recorder.ego_to_global(time_us * 1e-6)
        row = tables.add_data(sensor, index, time_us, is_key, pose, size)
        files.append(SensorFile(sensor, time_us, is_key, index, *row))
    return files


def _annotate(
    tables: NuScenesTables, recorder: Recorder, index: int, visible: np.ndarray, lidar_points: np.ndarray
) -> None:
    """Adds the boxes of key frame `index`: objects in range that a camera or the LiDAR sees."""
    seconds = index * KEY_FRAME_US * 1e-6
    ego = STREET_TO_GLOBAL @ recorder.ego_to_street(seconds)
    for item, fraction, points in zip(recorder.objects, visible.tolist(), lidar_points.tolist(), strict=True):
        if item.category is None or not (fraction or points):
            continue
        box = recorder.box_to_global(item, seconds)
        if np.linalg.norm((box - ego)[:2, 3]) <= ANNOTATED_RANGE:
            tables.add_annotation(
                item.name, item.category, item.attribute, index, box, item.mesh.size, fraction, points
            )


_worker: tuple[Recorder, Path]
"""In a worker process: the recorder and the dataset's root."""


def _start_worker(world: WorldSettings, root: Path) -> None:
    global _worker
    _worker = Recorder(world), root


def _write_file(file: SensorFile) -> np.ndarray | None:
    """Writes an image or a sweep. Returns the number of LiDAR returns per object, None for images."""
    recorder, root = _worker
    with atomic_write(root / file.path) as target:
        if file.sensor.is_camera:
            image = recorder.image(file.sensor, file.time_us)
            Image.fromarray(image).save(target, "JPEG", quality=JPEG_QUALITY)
            return None
        points, counts = recorder.sweep(file.sensor, file.time_us)
        target.write(points.tobytes())
        return counts


def _visible_fractions(index: int) -> np.ndarray:
    return _worker[0].visible_fractions(index)


def _write_truth(file: SensorFile) -> TruthFrame:
    recorder, root = _worker
    return write_truth_frame(root, recorder, file.sensor, file.index, file.time_us, file.token)
