"""LiDAR scans of an edited drive, or of one beside the recorded path: the recorded rays, fired from where the sensor
now is."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
from drivesplat.errors import ConfigError
from drivesplat.lidar.moved_sensor import places_of_returns
from drivesplat.lidar.objects_met import TrackedBoxes
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import NO_OBJECT, RecordedScan
from drivesplat.scene.scene import Scene, Track
from drivesplat.settings.export import ScanFolderJob
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
