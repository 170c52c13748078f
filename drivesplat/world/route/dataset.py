"""Makes the dataset of a world with a route, stretch by stretch, and merges the stretches into tables.

Each stretch has a file below stretches/ with its ego poses and boxes. Where a world is made again, and nothing but the
length of its drive has changed, the stretches that it has already are kept.
"""

import json
import logging
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from drivesplat.io.storage import Provenance, canonical_json, read_record, sha256_text, write_json
from drivesplat.readers.truth import RULE, Truth, write_truth_file
from drivesplat.scene.rigid import rigid
from drivesplat.settings.world import WorldJob
from drivesplat.world.marker import prepare_folder, refuse_foreign_data, write_marker
from drivesplat.world.optics.rig import image_height, key_frame_time
from drivesplat.world.output.recordings import (
    SEMANTIC,
    SKY,
    KeyFrameBox,
    SensorFile,
    boxes,
    require_space,
    sensor_files,
    world_bytes,
    write_recording,
)
from drivesplat.world.output.tables import NuScenesTables
from drivesplat.world.recorder import STREET_TO_GLOBAL, Recorder
from drivesplat.world.route.scenery import build_makes
from drivesplat.world.route.stretch import RouteDrive
from drivesplat.world.shapes.mesh import SurfaceClass

log = logging.getLogger(__name__)

STRETCHES = "stretches"
"""Folder below the dataset's root."""


def write_route(root: Path, job: WorldJob, provenance: Provenance, workers: int) -> None:
    """Writes the dataset below `root`; see `drivesplat.world.generate.make_world`. Its truth.json has no views."""
    refuse_foreign_data(root)
    drive = _Drive(root, job, _digest(job, provenance))
    kept = [index for index in range(drive.route.stretches) if drive.is_made(index)]
    if kept:
        write_marker(root, provenance)
    else:
        prepare_folder(root, provenance)
    missing = [index for index in range(drive.route.stretches) if index not in kept]
    images, sweeps = drive.count(missing)
    require_space(root, world_bytes(job.world, images, sweeps, 0, 0))
    build_makes()
    for begin in range(0, len(missing), workers):  # new processes for each few stretches: old ones keep memory
        some = missing[begin : begin + workers]
        with ProcessPoolExecutor(len(some), multiprocessing.get_context("fork"), _start_worker, (drive,)) as pool:
            for index in pool.map(_make, some):
                log.info("stretch %d of %d is made", index + 1, drive.route.stretches)
    drive.delete_others()
    _merge(drive, sha256_text(canonical_json(provenance["stages"])))


class _Drive:
    """The dataset of the drive of `job` below `root`. `digest` is that of everything but the length of the drive."""

    def __init__(self, root: Path, job: WorldJob, digest: str):
        self.root, self.job, self.digest = root, job, digest
        self.route = RouteDrive(job.world)
        self._files: dict[int, list[SensorFile]] = {index: [] for index in range(self.route.stretches)}
        for file in sensor_files(job.world, job.scene):
            self._files[self.route.stretch_of(file.index)].append(file)

    def files(self, index: int) -> list[SensorFile]:
        """The recordings of a stretch."""
        return self._files[index]

    def count(self, stretches: list[int]) -> tuple[int, int]:
        """Number of images and of sweeps of some stretches."""
        cameras = [file.sensor.is_camera for index in stretches for file in self._files[index]]
        return sum(cameras), len(cameras) - sum(cameras)

    def record(self, index: int) -> Path:
        """The file of a stretch."""
        return self.root / STRETCHES / f"{index:04}.json"

    def is_made(self, index: int) -> bool:
        """Whether a stretch exists as it would be made again."""
        try:
            made = json.loads(self.record(index).read_text(encoding="utf-8"))
            complete = made["digest"] == self.digest and made["key_frames"] == list(self.route.key_frames(index))
        except (KeyError, OSError, RecursionError, TypeError, ValueError):
            return False
        return complete and all(
            (self.root / path).is_file() for file in self.files(index) for path in self._paths(file)
        )

    def _paths(self, file: SensorFile) -> list[str]:
        """The files of a recording."""
        if not (file.sensor.is_camera and self.job.world.class_maps):
            return [file.path]
        name = f"{file.sensor.channel}/{PurePosixPath(file.path).stem}.png"
        return [file.path, f"{SEMANTIC}/{name}", f"{SKY}/{name}"]

    def make(self, index: int) -> None:
        """Writes the recordings of a stretch, and last its file."""
        stretch, world = self.route.stretch(index), self.job.world
        pose = STREET_TO_GLOBAL @ rigid(np.eye(3), np.array([*stretch.origin, 0.0]))
        recorder = Recorder(world, self.job.scene, street=stretch.street, street_to_global=pose)
        recordings, found = [], []
        for file in self.files(index):
            points = write_recording(self.root, recorder, file)
            ego_to_global = recorder.ego_to_global(file.time_us * 1e-6)
            recordings.append({"token": file.token, "ego_to_global": ego_to_global.tolist()})
            if points is not None and file.is_key_frame:
                found += boxes(recorder, file.index, recorder.visible_fractions(file.index), points)
        rows = [{**asdict(box), "pose": box.pose.tolist(), "size": box.size.tolist()} for box in found]
        content = {"digest": self.digest, "key_frames": self.route.key_frames(index)}
        write_json(self.record(index), {**content, "recordings": recordings, "boxes": rows})

    def delete_others(self) -> None:
        """Deletes recordings and stretches of an earlier, longer drive."""
        own = {path for files in self._files.values() for file in files for path in self._paths(file)}
        own |= {f"{STRETCHES}/{self.record(index).name}" for index in self._files}
        for folder in ("samples", "sweeps", SEMANTIC, SKY, STRETCHES):
            for path in (self.root / folder).rglob("*"):
                if path.is_file() and path.relative_to(self.root).as_posix() not in own:
                    path.unlink()


_worker: _Drive
"""In a worker process."""


def _start_worker(drive: _Drive) -> None:
    global _worker
    _worker = drive


def _make(index: int) -> int:
    _worker.make(index)
    return index


def _merge(drive: _Drive, source: str) -> None:
    """Writes truth.json, and the tables of all stretches. `source`: see `NuScenesTables`."""
    job, world = drive.job, drive.job.world
    description = (
        f"Route through a grid of streets, {'night' if world.night else 'day'}, {world.seconds:g} s; in ten seconds "
        f"{world.vehicles} moving vehicles, {world.pedestrians} pedestrians"
    )
    tables = NuScenesTables(job.scene, description, source, world)
    for index in range(world.key_frames):
        tables.add_sample(index, key_frame_time(world, index))
    stretches = [
        read_record(drive.record(index), RULE, "recordings", "boxes") for index in range(drive.route.stretches)
    ]
    poses = {row["token"]: np.array(row["ego_to_global"]) for stretch in stretches for row in stretch["recordings"]}
    for file in sensor_files(world, job.scene):
        tables.add_data(file, poses[file.token])
    for row in (row for stretch in stretches for row in stretch["boxes"]):
        tables.add_box(KeyFrameBox(**{**row, "pose": np.array(row["pose"]), "size": np.array(row["size"])}))
    truth = Truth(
        scene=job.scene, width=world.width, height=image_height(world.width), samples_per_pixel=world.samples_per_pixel,
        leading=None, instances={}, classes={str(int(c)): c.name.lower() for c in SurfaceClass}, views=(), pattern=None,
        scans=(),
    )  # fmt: skip
    write_truth_file(drive.root, truth)
    tables.write(drive.root, job.version)
    log.info("%d recordings, %d boxes in %s", len(poses), len(tables.rows["sample_annotation"]), drive.root)


def _digest(job: WorldJob, provenance: Provenance) -> str:
    """The digest of all that a world is made of, but for the number of its key frames."""
    stages: dict[str, Any] = deepcopy(provenance["stages"])
    settings = job.model_dump(mode="json")
    for made in (settings, *(stage["settings"] for stage in stages.values())):
        made.get("world", {}).pop("key_frames", None)
    return sha256_text(canonical_json([stages, settings]))
