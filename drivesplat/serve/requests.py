"""Requests for images and scans, checked before any model is touched."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from drivesplat.drive.cameras import PlacedCamera, PoseableCamera
from drivesplat.drive.lidars import PoseableLidar
from drivesplat.serve.camera_specs import camera_of
from drivesplat.serve.encoding import FORMATS, Encoding
from drivesplat.serve.faults import ServiceError, invalid
from drivesplat.serve.lidar_patterns import PATTERNS
from drivesplat.serve.messages import wire
from drivesplat.serve.poses import FrameTimes, ListedObjects, steady_poses
from drivesplat.settings.blocks import drive_of

QUALITY = 95.0
"""JPEG quality of a request that states none."""
MAX_REQUEST_PIXELS = 67_108_864
"""Pixels of all images of a request."""
MAX_REQUEST_SCANS = 16
"""Scans of a request: a scan may take 15 MB of a reply."""


@dataclass(frozen=True)
class WorldKey:
    """What the world of a request depends on: requests with equal keys are rendered together. `scene_id` is the id by
    which a scene is offered, whichever of its ids a request has; `origin` that of its world (`ScenePlace`); `listed`
    are the dynamic objects as bytes of their messages."""

    scene_id: str
    origin: tuple[float, ...]
    times: FrameTimes
    listed: bytes


@dataclass(frozen=True, eq=False)
class ScenePlace:
    """The scene that a request is about, by the id by which it is offered, and the origin (3,) of its world in metres
    of the world of the request: not zero for a block of a long drive."""

    scene_id: str
    origin: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class ImageRequest:
    """An image: its world, with the poses of the `objects` that the request lists; the camera, its pose (4, 4) and
    velocity (6,) at the time of the world; how the image is encoded; and the camera whose ego mask is drawn into it, if
    any."""

    world: WorldKey
    objects: ListedObjects
    camera: PoseableCamera
    camera_to_world: Float64[np.ndarray, "4 4"]
    velocity: Float64[np.ndarray, "6"]
    encoding: Encoding
    mask_of: str | None

    @property
    def pixels(self) -> int:
        return self.camera.width * self.camera.height

    def placed(self, time: float) -> PlacedCamera:
        """The camera at a time in seconds since the first image."""
        return PlacedCamera(self.camera, self.camera_to_world, self.velocity, time)


@dataclass(frozen=True, eq=False)
class ScanRequest:
    """A scan: its world and objects as of an image; the LiDAR, None for the scene's own; its pose (4, 4) and velocity
    (6,) at the middle of the spin, and its pose at the end."""

    world: WorldKey
    objects: ListedObjects
    lidar: PoseableLidar | None
    sensor_to_world: Float64[np.ndarray, "4 4"]
    velocity: Float64[np.ndarray, "6"]
    end_to_world: Float64[np.ndarray, "4 4"]


class RequestReader:
    """Reads the messages of one call. Requests of one frame list the same objects, which are read once."""

    def __init__(self, place: Callable[[str, FrameTimes], ScenePlace]) -> None:
        """`place` says which scene a request with a scene id and times is about."""
        self._place = place
        self._objects: dict[WorldKey, ListedObjects] = {}

    def image(self, message: Any) -> ImageRequest:
        """A request for an image. Raises ServiceError for a scene that is not served, and for a request that no scene
        can answer."""
        spec = message.camera_intrinsics
        times = FrameTimes.checked(
            message.frame_start_us, message.frame_end_us, spec.shutter_type == wire.ShutterType.GLOBAL
        )
        place = self._place(message.scene_id, times)
        length_us = message.frame_end_us - message.frame_start_us
        camera = camera_of(spec, message.resolution_w, message.resolution_h, length_us)
        steady = steady_poses([message.sensor_pose], ["sensor_pose"], times).seen_from(place.origin)
        world, objects = self._world(message, place, times)
        mask = (message.ego_mask_id.camera_logical_id or spec.logical_id) if message.insert_ego_mask else None
        return ImageRequest(
            world, objects, camera, steady.poses[0], steady.velocities[0], _encoding(message), mask
        )  # fmt: skip

    def scan(self, message: Any) -> ScanRequest:
        """A request for a scan, as `image`."""
        times = FrameTimes.checked(message.frame_start_us, message.frame_end_us, at_start=False)
        place, lidar = self._place(message.scene_id, times), None
        if message.HasField("lidar_config"):
            kind = message.lidar_config.lidar_type
            if kind not in PATTERNS:
                raise invalid(f"lidar_type {kind} is none of {', '.join(f'{t.value} ({t.name})' for t in PATTERNS)}")
            lidar = PATTERNS[kind](times.length_s)
        pair, at_start = message.sensor_pose, FrameTimes(times.start_us, times.end_us, at_start=True)
        steady = steady_poses([pair], ["sensor_pose"], times)
        reverse = wire.PosePair(start_pose=pair.end_pose, end_pose=pair.start_pose)
        end = steady_poses([reverse], ["sensor_pose"], at_start)
        steady, end = steady.seen_from(place.origin), end.seen_from(place.origin)
        world, objects = self._world(message, place, times)
        return ScanRequest(world, objects, lidar, steady.poses[0], steady.velocities[0], end.poses[0])

    def _world(self, message: Any, place: ScenePlace, times: FrameTimes) -> tuple[WorldKey, ListedObjects]:
        alone = wire.RGBRenderRequest(dynamic_objects=message.dynamic_objects)
        listed = alone.SerializeToString(deterministic=True)
        key = WorldKey(place.scene_id, tuple(place.origin.tolist()), times, listed)
        if key not in self._objects:
            objects = ListedObjects.of(message.dynamic_objects, times)
            self._objects[key] = replace(objects, steady=objects.steady.seen_from(place.origin))
        return key, self._objects[key]


def _encoding(message: Any) -> Encoding:
    if message.image_format not in FORMATS:
        known = ", ".join(f"{kind.value} ({kind.name})" for kind in FORMATS)
        raise invalid(f"image_format {message.image_format} is not supported; there are: {known}")
    quality = message.image_quality or QUALITY
    if not (math.isfinite(quality) and 1.0 <= quality <= 100.0):
        raise invalid(f"image_quality is {quality:g}; it must be 1 to 100, or 0 for {QUALITY:g}")
    return Encoding(wire.ImageFormat(message.image_format), round(quality))


def _drive_of(scene_id: str) -> tuple[str, str]:
    """The drive and the method of a scene, `scene` or `scene/method`."""
    scene, _, method = scene_id.partition("/")
    return drive_of(scene), method


def require_affordable(requests: Iterable[ImageRequest | ServiceError], max_scenes: int) -> None:
    """Raises ServiceError (RESOURCE_EXHAUSTED) for images of one call that are too large together, or of more scenes
    than are loaded at a time; blocks of one long drive count as one."""
    images = [one for one in requests if isinstance(one, ImageRequest)]
    pixels, scenes = sum(one.pixels for one in images), len({_drive_of(one.world.scene_id) for one in images})
    if pixels > MAX_REQUEST_PIXELS:
        raise ServiceError(
            "RESOURCE_EXHAUSTED", f"the request has {pixels} pixels in all; it may have {MAX_REQUEST_PIXELS}"
        )
    if scenes > max_scenes:
        raise ServiceError(
            "RESOURCE_EXHAUSTED", f"the request names {scenes} scenes, and {max_scenes} can be loaded at a time"
        )
