"""The stage `run_folder`: a run in the closed loop as a drive folder, with what the sensors of its policy measured and
where everything was."""

import logging
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.drive.cameras import PoseableCamera
from drivesplat.drive.lidars import PoseableLidar
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError
from drivesplat.io.jpeg import encoded_jpeg
from drivesplat.io.storage import Provenance, atomic_write
from drivesplat.readers.drive.reader import READER
from drivesplat.readers.drive.write import write_record, write_sweep
from drivesplat.scene.scene import Frame, Scene, Sweep, Track
from drivesplat.scene.sensors import Camera, LidarReturns
from drivesplat.settings.simulate import RunJob
from drivesplat.simulate.episodes import driven_episode
from drivesplat.simulate.policies import policy_of, settings_for
from drivesplat.simulate.simulation import Simulation
from drivesplat.simulate.trust import Trust

log = logging.getLogger(__name__)

SAME_M = 0.01
"""Metres between the paths of two runs from which on they are not the same."""
SIMULATED = "simulated"
"""The source of the poses of a run."""


def write_run_drive(
    drive: TrainedDrive,
    job: RunJob,
    path: Path,
    source: Mapping[str, str],
    record: Mapping[str, Any],
    provenance: Provenance,
) -> None:
    """Drives the first episode of a run again, and writes it into the folder of `path`, its drive.json: an image of
    each camera of the policy and a sweep of its LiDAR at every step, the path of the ego vehicle, and the boxes of all
    objects.

    `source` names the `scene`, the `method` and the `run`; `record` is what the run has written. Warns where the
    vehicle drives elsewhere than in `record`, as policies may that see images of a GPU. Raises RequestError for a run
    without sensors, and where its policy cannot be made or fails before the first step; what `Simulation` raises.
    """
    run, where = job.run, f"run {source['run']}"
    edited = drive if job.edit is None else drive.edited(job.edit)
    policy = policy_of(run.policy, run.policy_settings)
    simulation = Simulation(edited, settings_for(run.simulation, policy))
    if not simulation.cameras and simulation.lidar is None:
        raise RequestError(f"{where} has no sensor to record; name a camera in its simulation.cameras, or a lidar")
    Trust(edited).inform(simulation)
    _remove(path.parent)
    recorder = _Recorder(simulation, path.parent)
    try:
        episode = driven_episode(simulation, policy, run.seeds[0], run.timeout_s, recorder.note)
        if not recorder.times:
            raise RequestError(f"{where}: {episode.failed}")
        _compare(where, episode.run.ego_to_world[:, :3, 3], record)
        rendered = {
            **source, "edit": run.edit, "seed": run.seeds[0],
            "steps": None if job.edit is None else job.edit.model_dump(mode="json", exclude_none=True)["steps"],
            "shown_by": _shown_by(edited), "provenance": provenance,
        }  # fmt: skip
        write_record(path, recorder.scene(source), rendered)
    except BaseException:
        _remove(path.parent)
        raise


class _Recorder:
    """Writes what the sensors of a simulation measure into a `folder`."""

    def __init__(self, simulation: Simulation, folder: Path):
        scene = simulation.drive.scene
        self._simulation, self._folder = simulation, folder
        self._start = min(recording.timestamp for recording in scene.frames or scene.sweeps)
        self.times: list[int] = []
        self._frames: list[Frame] = []
        self._sweeps: list[Sweep] = []

    def note(self, now: Simulation) -> None:
        self.times.append(self._start + round(now.time * 1e6))
        world = now.world()
        if now.cameras:
            views = world.render(list(now.cameras.values()), **now.place)
            for (name, camera), view in zip(now.cameras.items(), views, strict=True):
                self._image(name, camera, view.image)
        if now.lidar is not None:
            self._sweep(now.lidar)

    def _image(self, name: str, camera: PoseableCamera, pixels: np.ndarray) -> None:
        now, time = self._simulation, self.times[-1]
        file = self._folder / "images" / name / f"{time}.jpg"
        with atomic_write(file) as opened:
            opened.write(encoded_jpeg(pixels))
        pose, mount = now.ego_to_world, camera.camera_to_ego
        assert mount is not None
        seen_from = now.drive.camera_to_world(name, now.time) if now.follows else pose @ mount
        frame = Frame(
            name, time, str(file), camera.width, camera.height, camera.lens.intrinsics, seen_from, pose, True,
            len(self.times) - 1, f"{name}/{time}", readout_middle_s=float(camera.readout_s[2]),
        )  # fmt: skip
        self._frames.append(frame)

    def _sweep(self, lidar: PoseableLidar) -> None:
        now, time, name = self._simulation, self.times[-1], self._simulation.settings.lidar
        assert name is not None
        scan = now.world().scan(lidar, **now.place, with_instance=False)
        returned = scan.returned.cpu().numpy()
        returns = LidarReturns(
            scan.points("sensor"),
            scan.intensity.cpu().numpy()[returned].clip(0.0, 1.0).astype(np.float32),
            np.nonzero(returned)[0],
            scan.sensor.scan.rays.offsets_s[returned].astype(np.float64),
        )
        file = self._folder / "sweeps" / name / f"{time}.npz"
        write_sweep(file, returns)
        pose = scan.sensor.sensor_to_world
        self._sweeps.append(Sweep(str(file), time, pose, True, len(self.times) - 1, f"{name}/{time}", name, READER))

    def scene(self, source: Mapping[str, str]) -> Scene:
        """The drive so far."""
        recorded, what = self._simulation.drive.scene, " ".join(f"{key} {value}" for key, value in source.items())
        lidars = {sweep.lidar for sweep in self._sweeps}
        return replace(
            recorded,
            name=f"{source['scene']}_{source['run']}",
            description=f"Simulated by drivesplat, not recorded ({what}). {recorded.description}".strip(),
            key_frame_timestamps=np.array(self.times, dtype=np.int64),
            frames=tuple(sorted(self._frames, key=lambda frame: frame.camera)),
            sweeps=tuple(self._sweeps),
            tracks=tuple(self._tracks()),
            poses=SIMULATED,
            cameras=tuple(self._camera(name, camera) for name, camera in sorted(self._simulation.cameras.items())),
            lidars=tuple(lidar for lidar in recorded.lidars if lidar.name in lidars),
        )

    def _camera(self, name: str, camera: PoseableCamera) -> Camera:
        known = {own.name: own for own in self._simulation.drive.scene.cameras}.get(name)
        rolling = bool(camera.readout_s.any()) and known is not None
        return replace(
            camera.lens, name=name, distortion=np.zeros(5), readout_s=known.readout_s if rolling and known else 0.0,
            readout_direction=known.readout_direction if rolling and known else None,
        )  # fmt: skip

    def _tracks(self) -> list[Track]:
        """All objects at the steps at which they are there."""
        categories = {actor.id: actor.category for actor in self._simulation.traffic.actors}
        stamps, found = np.array(self.times, dtype=np.int64), []
        for other in self._simulation.driven().others:
            at = np.flatnonzero(other.present[: len(stamps)])
            if len(at):
                poses = other.object_to_world[at]
                unknown = np.zeros(len(at), dtype=np.int64)
                category = categories[other.id]
                found.append(Track(other.id, other.object_class, category, other.size, stamps[at], at, poses, unknown))
        return found


def _shown_by(drive: TrainedDrive) -> dict[str, str]:
    """What shows each object in images, by its id."""
    static = drive.static_objects
    shown = {item.id: min(parts, default="none") for item, parts in zip(static.others, static.parts, strict=True)}
    return {**shown, **{actor.id: "own" for actor in drive.edited_actors}}


def _compare(where: str, places: np.ndarray, record: Mapping[str, Any]) -> None:
    """Warns where a run drives elsewhere than its record says."""
    episodes = record.get("episodes") or [{"path": []}]
    before = np.array([row[1:4] for row in episodes[0]["path"]]).reshape(-1, 3)
    common = min(len(before), len(places))
    apart = np.linalg.norm(before[:common] - places[:common], axis=1).max(initial=0.0)
    if apart > SAME_M or len(before) != len(places):
        log.warning(
            "%s: driven again, the vehicle takes %d steps in place of %d, and is up to %.2f m from where it was; its "
            "policy does not drive the same twice",
            where, len(places) - 1, len(before) - 1, apart,
        )  # fmt: skip


def _remove(folder: Path) -> None:
    """Removes the images and sweeps of an earlier or a failed run."""
    for part in (folder / "images", folder / "sweeps"):
        if part.exists():
            shutil.rmtree(part)
