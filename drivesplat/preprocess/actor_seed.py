"""The stage `actors`: which vehicles become actors, and the initial points of their Gaussians.

The points are the LiDAR returns of the training sweeps in an actor's box, accumulated over the drive in the actor's
frame, plus random points in the box where there are few returns (Street Gaussians, Yan et al. 2024, arXiv 2401.01339),
and on the sides and the roof of a vehicle's box above the highest returns: of a truck close ahead LiDAR meets the lower
half. Colours come from training images that show the actor. Held-out images and sweeps contribute nothing.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from drivesplat.io.prefetch import prefetch
from drivesplat.lidar.coloring import in_image
from drivesplat.lidar.dynamic_objects import DynamicObject, dynamic_objects
from drivesplat.lidar.sweeps import returns_of
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.images import continuous_intrinsics, read_image, target_size
from drivesplat.scene.recorded_shutters import shutter_of
from drivesplat.scene.regions import MIN_PIXELS, hulls_in, owner_image
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.scene.shutter import Shutter, where_seen
from drivesplat.scene.splits import training_images
from drivesplat.settings.actor_seed import ActorSeedJob, ActorSeedSettings
from drivesplat.settings.train import PartName
from drivesplat.trajectories.actor_record import ActorRecord, ActorRecords
from drivesplat.trajectories.smoothing import smoothed

log = logging.getLogger(__name__)

HIGHEST = 0.98
"""Quantile of the heights of an actor's LiDAR points up to which LiDAR reaches; higher points count as outliers."""
MIN_UNREACHED = 0.3
"""Minimum height in metres above the highest LiDAR points of a box for random points there."""
UNSEEN = 127
"""Grey level of an actor whose points no image shows."""


def actors_record(scene: Scene, job: ActorSeedJob, ego_mask: EgoMask = NO_EGO_MASK) -> ActorRecords:
    """The actors of a scene, without provenance. Dynamic objects that no training image shows are left out, in a scene
    without images those that no training sweep meets."""
    sweeps = returns_of(scene, job.holdout, job.own_car_radius)
    order = {track.id: i for i, track in enumerate(scene.tracks)}
    seeds = []
    for dynamic_object in sorted(dynamic_objects(scene), key=lambda item: item.track.id):
        parts = job.actors.parts_of(dynamic_object.track.object_class)
        if parts:
            if job.actors.smoothed:
                dynamic_object = replace(dynamic_object, motion=smoothed(dynamic_object.motion))
            random = np.random.default_rng((job.random_seed, order[dynamic_object.track.id]))
            points = gathered_points(scene, dynamic_object, sweeps, job.actors, random)
            seeds.append(Seed(dynamic_object, parts, *points))
    frames = [scene.frames[i] for i in training_images(scene, job.holdout)]
    for view in prefetch(lambda frame: actor_view(scene, frame, job, ego_mask), frames):
        for seed in seeds:
            seed.add_view(view)
    kept = [seed for seed in seeds if (seed.seen if scene.frames else seed.lidar > 0)]
    unseen = [seed.dynamic_object.track.id for seed in seeds if seed not in kept]
    if unseen:
        where = "training image shows" if scene.frames else "training sweep meets"
        log.info("%d dynamic tracks that no %s are left out: %s", len(unseen), where, ", ".join(unseen))
    actors = [seed.record() for seed in kept]
    for actor in actors:
        log.info("%s: %d points, %d of them from LiDAR", actor.id, len(actor.points), actor.lidar_points)
    return ActorRecords(actors)


def gathered_points(
    scene: Scene,
    dynamic_object: DynamicObject,
    sweeps: list[tuple[Sweep, np.ndarray]],
    settings: ActorSeedSettings,
    random: np.random.Generator,
) -> tuple[np.ndarray, int]:
    """Points (n, 3) in an object's frame, LiDAR points before random ones, and the number of LiDAR points.

    `sweeps` come with their returns (m, 3) in world coordinates.
    """
    track = dynamic_object.track
    in_box = (
        dynamic_object.own(points, scene.seconds(sweep.timestamp), settings.box_margin) for sweep, points in sweeps
    )
    lidar = np.concatenate([np.empty((0, 3)), *in_box])
    target = min(settings.random_points, settings.max_points)
    if len(lidar) < settings.min_points:
        filling = random.uniform(-0.5, 0.5, (max(0, target - len(lidar)), 3)) * track.size
    elif len(lidar) and track.object_class.is_solid:
        # on the sides and the roof above what LiDAR reaches: `target` times the share of the height that it does not
        reached, half = float(np.quantile(lidar[:, 2], HIGHEST)), track.size[2] / 2.0
        unreached = half - reached
        count = round(target * min(1.0, unreached / track.size[2])) if unreached >= MIN_UNREACHED else 0
        filling = random.uniform(-0.5, 0.5, (count, 3)) * track.size
        filling[:, 2] = random.uniform(reached, max(reached, half), count)
        sides = np.where(filling < 0.0, -0.5, 0.5) * track.size
        sides[:, 2] = half
        rows, nearest = np.arange(count), np.abs(sides - filling).argmin(axis=1)
        filling[rows, nearest] = sides[rows, nearest]
    else:
        filling = np.empty((0, 3))
    most = settings.max_points - len(filling)
    if len(lidar) > most:
        lidar = lidar[np.sort(random.choice(len(lidar), most, replace=False))]
    return np.concatenate([lidar, filling]), len(lidar)


@dataclass(frozen=True)
class ActorView:
    """A training image: `pixels` (h, w, 3) uint8 RGB; `owners` (h, w), the number of the track that each pixel shows or
    -1; `tracks`, these numbers by track id; `seen`, the ids of the visible tracks. `seconds` is the scene's time."""

    frame: Frame
    seconds: float
    intrinsics: np.ndarray
    pixels: np.ndarray
    owners: np.ndarray
    tracks: dict[str, int]
    seen: set[str]
    shutter: Shutter | None


def actor_view(scene: Scene, frame: Frame, job: ActorSeedJob, ego_mask: EgoMask) -> ActorView:
    """A frame with its visible tracks: those that cover MIN_PIXELS pixels and are not fully hidden by nearer boxes or
    the ego vehicle."""
    size = target_size(frame, job.images)
    hulls = hulls_in(scene, frame, size)
    owners, covered = owner_image(hulls, size)
    owners[ego_mask.pixels(frame.camera, size)] = -1
    tracks = {hull.box.track_id: number for number, hull in enumerate(hulls)}
    visible = np.bincount(owners[owners >= 0], minlength=len(hulls))
    seen = {track for track, number in tracks.items() if visible[number] and covered[number] >= MIN_PIXELS}
    pixels, intrinsics = read_image(frame.image_path, size), continuous_intrinsics(frame, size)
    shutter = shutter_of(scene, frame)
    return ActorView(frame, scene.seconds(frame.timestamp), intrinsics, pixels, owners, tracks, seen, shutter)


class Seed:
    """An actor's points, and their colours from the views added so far.

    A point has the colour of its nearest camera among those whose image shows the actor at the point's pixel.
    """

    def __init__(self, dynamic_object: DynamicObject, parts: tuple[PartName, ...], points: np.ndarray, lidar: int):
        self.dynamic_object, self._parts = dynamic_object, parts
        self.seen, self.pixels = False, 0
        self._points, self.lidar = points, lidar
        self._colors = np.zeros((len(points), 3), dtype=np.uint8)
        self._distances = np.full(len(points), np.inf)

    def add_view(self, view: ActorView) -> None:
        """Updates the colours of the points that this view sees from nearer than all earlier views."""
        self.seen |= self.dynamic_object.track.id in view.seen
        number, pose = view.tracks.get(self.dynamic_object.track.id), self.dynamic_object.pose(view.seconds)
        if number is None or pose is None:
            return
        self.pixels += int((view.owners == number).sum())
        seen_at = points = apply(pose, self._points)
        if view.shutter is not None:
            (height, width), own = view.owners.shape, self.dynamic_object.velocities(self._points, view.seconds)
            camera_to_world = view.frame.camera_to_world
            seen_at = where_seen(points, view.shutter, camera_to_world, view.intrinsics, (width, height), own)
        camera = inverse(view.frame.camera_to_world), view.intrinsics
        index, rows, columns, _ = in_image(seen_at, *camera, view.owners.shape)
        distances = np.linalg.norm(points[index] - view.frame.camera_to_world[:3, 3], axis=1)
        nearer = (view.owners[rows, columns] == number) & (distances < self._distances[index])
        self._distances[index[nearer]] = distances[nearer]
        self._colors[index[nearer]] = view.pixels[rows[nearer], columns[nearer]]

    def record(self) -> ActorRecord:
        """The actor's record. Points that no image shows get the mean colour of the others, or UNSEEN."""
        track, shown = self.dynamic_object.track, np.isfinite(self._distances)
        mean = self._colors[shown].mean(axis=0).round() if shown.any() else UNSEEN
        return ActorRecord(
            id=track.id,
            category=track.category,
            size=track.size,
            motion=self.dynamic_object.motion,
            points=self._points.astype(np.float32),
            points_rgb=np.where(shown[:, None], self._colors, mean).astype(np.uint8),
            lidar_points=self.lidar,
            pixels=self.pixels,
            parts=self._parts,
            object_class=str(track.object_class.value),
        )
