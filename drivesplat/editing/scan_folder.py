"""The stage `scan_folder`: writes rendered LiDAR scans of an edited drive, or of one beside the recorded path, as
files: the recorded rays, fired from where the sensor now is."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int16

from drivesplat.editing.actors import edited_model, trained_actors, warn_of_collisions
from drivesplat.editing.assets.asset import NO_INSERTS, Inserts
from drivesplat.editing.ego import EgoEdit
from drivesplat.editing.placed_model import placed_models
from drivesplat.editing.sensor_path import beside, carried, recorded_ego
from drivesplat.editing.shown_objects import parts_that_may_show
from drivesplat.errors import ConfigError, ResultError
from drivesplat.io.point_cloud import write_vertices
from drivesplat.io.storage import Provenance, atomic_write, write_json
from drivesplat.lidar.moved_sensor import places_of_returns, sensor_poses_of
from drivesplat.lidar.objects_met import TrackedBoxes
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import NO_OBJECT, RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene, Track
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.export import ScanFolderJob, ScanFormat
from drivesplat.trajectories.camera_path import recorded_frames
from drivesplat.trajectories.edited_actors import EditedActor


@dataclass(frozen=True)
class SimulatedScan:
    """What a LiDAR would have measured. `sensor` has its rays, its pose and its velocities (what else it holds was
    recorded); `rendered`, what the rays return; `objects`, the index into `ScanRenderPlan.objects` of what each return
    belongs to, or NO_OBJECT."""

    sensor: RecordedScan
    rendered: RenderedScan
    objects: Int16[np.ndarray, "b a"]

    @property
    def returned(self) -> Bool[np.ndarray, "b a"]:
        """The rays that return, without those that meet the ego vehicle or a broken sector."""
        return self.rendered.returned & self.sensor.measured

    def places(self) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
        """The returns in world coordinates, beam by beam, and the sensor's positions at their times, metres."""
        return places_of_returns(self.sensor, self.rendered.ranges, self.returned)


def write_scan_folder(
    scene: Scene,
    checkpoint: TrainedCheckpoint,
    records: ScanRecords,
    job: ScanFolderJob,
    device_settings: DeviceSettings,
    path: Path,
    source: dict[str, str],
    provenance: Provenance,
    inserts: Inserts = NO_INSERTS,
) -> None:
    """Writes the scans of `records` after the edit of `job` or along its trajectory into the folder of `path`, and last
    `path`, scans.json, which lists them.

    `source` names the `scene`, the `method`, and the `edit` or the `trajectory`; the edit inserts `inserts`.
    Raises what `scan_render_plan` raises;
    DeviceError; ResultError for a model that was trained without LiDAR, where a rendering contains NaN or Inf, or where
    the disk is full.
    """
    what = " ".join(f"{key} {value}" for key, value in source.items())
    model, _ = open_model(checkpoint, device_settings)
    drive = scan_render_plan(scene, model, records.scans, job, what, inserts)
    objects, folder, listed = drive.objects(), path.parent, []
    _remove_scans(folder)
    try:
        with explain_out_of_memory(lambda: len(model)):
            for found in drive.simulated(checkpoint.job.train.scans.beam_spread_rad):
                values = (found.rendered.ranges, found.rendered.drops, found.rendered.intensities)
                if not all(np.isfinite(array).all() for array in values):
                    raise ResultError(
                        f"{what}: a rendered scan contains NaN or Inf; delete checkpoint.npz and train again"
                    )
                listed.append(_written(folder, found, job.formats, [item["id"] for item in objects]))
        steps = None if job.edit is None else job.edit.model_dump(mode="json", exclude_none=True)["steps"]
        offset = None if job.trajectory is None else job.trajectory.model_dump(exclude={"parts"})
        record = {**source, "steps": steps, "offset": offset, "origin": scene.origin.tolist()}
        write_json(path, {**record, "objects": objects, "scans": listed, "provenance": provenance})
    except BaseException:
        _remove_scans(folder)
        raise


def _remove_scans(folder: Path) -> None:
    """Removes the scans of an earlier or a failed run."""
    for kind in _WRITERS:
        for file in folder.glob(f"*/*.{kind}"):
            if file.name.removesuffix(f".{kind}").isdigit():
                file.unlink()


def _written(folder: Path, found: SimulatedScan, formats: Sequence[ScanFormat], objects: list[str]) -> dict[str, Any]:
    """Writes the files of a scan; returns its entry in scans.json."""
    sensor, files = found.sensor, {}
    for kind in formats:
        files[kind] = f"{sensor.lidar}/{sensor.timestamp}.{kind}"
        _WRITERS[kind](folder / files[kind], found, objects)
    return {
        "lidar": sensor.lidar,
        "timestamp": sensor.timestamp,
        "seconds": sensor.seconds,
        "is_key_frame": sensor.is_key_frame,
        "group": sensor.group,
        "sensor_to_world": sensor.sensor_to_world.tolist(),
        "linear": sensor.linear.tolist(),
        "angular": sensor.angular.tolist(),
        "rays": int(sensor.measured.sum()),
        "returns": int(found.returned.sum()),
        "files": files,
    }


def write_rays(path: Path, found: SimulatedScan, _: list[str]) -> None:
    sensor, rays, rendered = found.sensor, found.sensor.scan.rays, found.rendered
    with atomic_write(path) as file:
        np.savez_compressed(
            file,
            azimuths=rays.azimuths,
            elevations=rays.elevations,
            offsets_s=rays.offsets_s,
            ranges=rendered.ranges.astype(np.float32),
            intensities=rendered.intensities.astype(np.float32),
            drops=rendered.drops.astype(np.float32),
            returned=found.returned,
            measured=sensor.measured,
            objects=found.objects,
            timestamp=np.int64(sensor.timestamp),
            seconds=np.float64(sensor.seconds),
            sensor_to_world=sensor.sensor_to_world,
            linear=sensor.linear,
            angular=sensor.angular,
        )


def write_points(path: Path, found: SimulatedScan, objects: list[str]) -> None:
    """Writes the returns in world coordinates as .ply, with the ids of `objects` in its header."""
    rings, _ = np.nonzero(found.returned)
    x, y, z = found.places()[0].T.astype(np.float32)
    columns = {
        "x": x,
        "y": y,
        "z": z,
        "intensity": found.rendered.intensities[found.returned].astype(np.float32),
        "ring": rings.astype(np.uint16),
        "time": found.sensor.scan.rays.offsets_s[found.returned],
        "object": found.objects[found.returned],
    }
    write_vertices(path, columns, {"timestamp": found.sensor.timestamp, "frame": "world", "objects": objects})


def write_nuscenes(path: Path, found: SimulatedScan, _: list[str]) -> None:
    """Writes the returns as nuScenes has them, by the order of their times: x, y, z in the sensor's frame at the
    timestamp, where the motion of the sensor is compensated, intensity from 0 to 255, and ring."""
    rings, _ = np.nonzero(found.returned)
    points = apply(inverse(sensor_poses_of(found.sensor)(np.zeros(1))[0]), found.places()[0])
    intensity = 255.0 * found.rendered.intensities[found.returned].clip(0.0, 1.0)
    columns = np.column_stack([points, intensity.round(), rings]).astype(np.float32)
    order = np.argsort(found.sensor.scan.rays.offsets_s[found.returned], kind="stable")
    with atomic_write(path) as file:
        file.write(columns[order].tobytes())


_WRITERS: dict[ScanFormat, Callable[[Path, SimulatedScan, list[str]], None]] = {
    "npz": write_rays,
    "ply": write_points,
    "pcd.bin": write_nuscenes,
}


@dataclass(frozen=True)
class ScanRenderPlan:
    """Scans to render: the `model` with the assets that an edit inserts; the rays of `sensors`, each with the pose and
    the velocities that the sensor then has; the `actors` of the model as they then are; and the annotated objects
    (`others`) that the model shows in its static part, with their `boxes`."""

    model: SplatModel
    sensors: Sequence[RecordedScan]
    actors: Sequence[EditedActor]
    others: Sequence[Track]
    boxes: TrackedBoxes

    def objects(self) -> list[dict[str, Any]]:
        """What returns may belong to, as plain data: id, track or asset whose Gaussians it has, category, class, and
        length, width, height in metres. First the actors, then the other objects."""
        return [
            {
                "id": item.id, "track": source, "category": item.category, "class": item.object_class.value,
                "size": [round(float(value), 4) for value in item.size],
            }
            for item, source in [*((own, own.source) for own in self.actors), *((own, own.id) for own in self.others)]
        ]  # fmt: skip

    @torch.no_grad()
    def simulated(self, beam_spread: tuple[float, float]) -> Iterator[SimulatedScan]:
        """The scans in order. `beam_spread` in radians."""
        of_boxes = np.full(max([*self.boxes.indices, -1]) + 2, NO_OBJECT)  # the last is what NO_OBJECT finds
        of_boxes[self.boxes.indices] = len(self.actors) + np.arange(len(self.others))
        times = np.array([sensor.seconds for sensor in self.sensors])
        for sensor, placed in zip(self.sensors, placed_models(self.model, self.actors, times), strict=True):
            view, now = placed.fixed.scan_view(sensor, beam_spread), np.array([sensor.seconds])
            rendered = placed.scan(view).rendered()
            objects = np.full(rendered.ranges.shape, NO_OBJECT, dtype=np.int16)
            found = SimulatedScan(sensor, rendered, objects)
            returned = found.returned
            present = [i for i, actor in enumerate(self.actors) if actor.present(now)[0]]
            of_placements = np.array([*present, NO_OBJECT], dtype=np.int16)  # the last is what -1 finds
            objects[returned] = of_placements[placed.objects_met(view).cpu().numpy()[returned]]
            # the static part shows what is in the boxes of the others
            seconds = sensor.seconds + sensor.scan.rays.offsets_s[returned].astype(np.float64)
            static = of_boxes[self.boxes.met(*found.places(), seconds)]
            objects[returned] = np.where(objects[returned] == NO_OBJECT, static, objects[returned])
            yield found


def scan_render_plan(
    scene: Scene, model: SplatModel, scans: Sequence[RecordedScan], job: ScanFolderJob, where: str,
    inserts: Inserts = NO_INSERTS,
) -> ScanRenderPlan:  # fmt: skip
    """The drive of `job`, whose edit inserts `inserts`: the rays of `scans`, as long as the ego vehicle is on
    its recorded path.

    Warns where a sensor is inside a vehicle. Raises ConfigError, starting with `where`, if the edit does not fit the
    scene, there is no camera or the model has no actors; DatasetError as `recorded_ego`; ResultError as
    `trained_actors`.
    """
    if job.edit is None:
        trained = actors = trained_actors(model, scene, where)
        sensors, offset = list(scans), job.trajectory
        if offset is not None and (offset.lateral or offset.vertical or offset.yaw):
            recorded = recorded_ego(scene, job.eval_camera)
            sensors = [beside(scan, recorded, offset) for scan in scans]
    else:
        if job.eval_camera is None:
            raise ConfigError(f"{where}: scans of edits need images, and the scene has no camera")
        edited = edited_model(model, scene, job.eval_camera, job.edit, where, inserts)
        model, trained, actors = edited.model, edited.recorded, edited.actors
        sensors, change = list(scans), EgoEdit.of(scene, job.eval_camera, job.edit, where)
        if change is not None and scans:
            frames, recorded = recorded_frames(scene, job.eval_camera), recorded_ego(scene, job.eval_camera)
            seconds = np.array([scan.seconds for scan in scans])
            within = change.within(frames, seconds, until=float(seconds.max()))
            kept = (scan for scan, inside in zip(scans, within, strict=True) if inside)
            sensors = [carried(scan, recorded, lambda times: change.poses(frames, times)[1]) for scan in kept]
    unseen = {track.id for track in scene.tracks if not parts_that_may_show(track, model)}
    boxes = TrackedBoxes.of_scene(scene, without=unseen | {actor.id for actor in trained})
    if sensors:
        poses, seconds = np.stack([s.sensor_to_world for s in sensors]), np.array([s.seconds for s in sensors])
        warn_of_collisions(actors, poses, seconds, where, "LiDAR")
    return ScanRenderPlan(model, sensors, actors, [scene.tracks[i] for i in boxes.indices], boxes)
