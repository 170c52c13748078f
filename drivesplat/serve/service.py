"""The rpcs of the sensor service: a method each, from a message to a message."""

import importlib
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import UInt8
from torch import Tensor

from drivesplat.drive.drive_view import DriveScan
from drivesplat.drive.world_state import WorldState
from drivesplat.editing.sensor_path import recorded_ego
from drivesplat.rendering.color_bytes import planes_on_device, uint8_images
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import Scene
from drivesplat.serve.camera_specs import spec_of
from drivesplat.serve.encoding import encoded, jpeg_on_device
from drivesplat.serve.faults import ServiceError, as_service_errors
from drivesplat.serve.figures import ServiceFigures
from drivesplat.serve.messages import wire
from drivesplat.serve.poses import ListedObjects, pose_message
from drivesplat.serve.requests import (
    MAX_REQUEST_SCANS,
    ImageRequest,
    RequestReader,
    ScanRequest,
    WorldKey,
    require_affordable,
)
from drivesplat.serve.scenes import DriveSource, LoadedDrive, LoadedDrives

API_VERSION = 0, 54, 0
"""The version of AlpaSim's messages that the service speaks."""
MAX_MESSAGE_BYTES = 64 * 1024 * 1024
"""Largest request and reply."""
Unlisted = Literal["removed", "recorded"]
"""What a request without any dynamic object shows of the objects that it could list."""
JpegEncoder = Literal["threads", "device"]
"""Where JPEGs are encoded: by OpenCV in threads, or by torchvision on the model's device."""
IsActive = Callable[[], bool]
"""Whether the client still waits for the reply."""
Result = TypeVar("Result")
Answered = Result | ServiceError
"""A result, or why there is none."""
Picture = UInt8[Tensor, "3 h w"] | UInt8[np.ndarray, "h w 3"]
"""The pixels of an image: on the device that will encode it, or in main memory."""


@dataclass(frozen=True)
class ServiceOptions:
    """How a service answers. `device` is 'cpu' or 'cuda'; at most `max_loaded` scenes are in memory; a request without
    dynamic objects shows those that it could list as `unlisted` says."""

    version: str
    device: str = "cpu"
    max_loaded: int = 2
    unlisted: Unlisted = "removed"
    jpeg: JpegEncoder = "threads"


class SensorService:
    """The rpcs of `SensorsimService`. Methods may be called from several threads: messages are read, and images
    encoded, side by side; one call at a time uses a model. They raise ServiceError."""

    def __init__(self, sources: Mapping[str, DriveSource], options: ServiceOptions):
        self.options, self._sources = options, sources
        self._drives = LoadedDrives(sources, options.device, options.max_loaded)
        self.figures = ServiceFigures(lambda: len(self._drives))
        self._lock = threading.Lock()
        self._encoders = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="drivesplat-encode")
        self._device_encoder = ThreadPoolExecutor(1, thread_name_prefix="drivesplat-encode-on-device")
        if options.jpeg == "device":
            importlib.import_module("torchvision.io")  # takes long, and must not begin in several threads

    @property
    def scene_ids(self) -> list[str]:
        """The ids that a simulator may know scenes by."""
        return self._drives.scene_ids

    def close(self) -> None:
        """Ends the threads that encode images."""
        self._encoders.shutdown()
        self._device_encoder.shutdown()

    # ---- what is served

    def get_version(self, request: Any, active: IsActive) -> Any:
        """The version of drivesplat, and of the messages."""
        number = dict(zip(("major", "minor", "patch"), API_VERSION, strict=True))
        version = wire.VersionId.APIVersion(**number)
        return wire.VersionId(version_id=f"drivesplat {self.options.version}", grpc_api_version=version)

    def get_available_scenes(self, request: Any, active: IsActive) -> Any:
        return wire.AvailableScenesReturn(scene_ids=self.scene_ids)

    def get_loaded_scenes(self, request: Any, active: IsActive) -> Any:
        """The scenes in memory, each of which serves any number of clients: once, by the id of its scene for AlpaSim
        where it has one."""
        entries = [
            wire.LoadedSceneEntry(scene_id=name, loaded_instance_count=1, reusable_instance_count=1)
            for name in self._drives.names
        ]
        return wire.LoadedScenesReturn(scenes=entries, loaded_instance_capacity=self.options.max_loaded)

    def get_available_cameras(self, request: Any, active: IsActive) -> Any:
        """The recorded cameras of a scene: the pinholes of its training images, with their shutters."""
        reply = wire.AvailableCamerasReturn()
        with self._loaded(request.scene_id, active) as loaded:
            for name in loaded.drive.cameras:
                camera = loaded.drive.camera(name, rolling_shutter=True)
                assert camera.camera_to_ego is not None
                mount = pose_message(camera.camera_to_ego)
                reply.available_cameras.add(
                    intrinsics=spec_of(camera, name), rig_to_camera=mount, logical_id=name
                )  # fmt: skip
        return reply

    def get_available_trajectories(self, request: Any, active: IsActive) -> Any:
        """The recorded path of the vehicle of a scene, at the times of its images (of its sweeps, without cameras)."""
        long_drive = self._drives.long_drives.get(request.scene_id)
        reply = wire.AvailableTrajectoriesReturn()
        if long_drive is None:
            with self._loaded(request.scene_id, active) as loaded:
                trajectory = _trajectory(loaded.drive.scene)
        else:
            with as_service_errors():
                trajectory = _trajectory(long_drive.record)
        reply.available_trajectories.add(trajectory=trajectory)
        return reply

    def get_available_ego_masks(self, request: Any, active: IsActive) -> Any:
        """The ego masks of all scenes: by camera, with the scene as `rig_config_id`."""
        reply = wire.AvailableEgoMasksReturn()
        of_drives = [(name, self._sources[drive.first]) for name, drive in self._drives.long_drives.items()]
        for name, source in [*of_drives, *self._sources.items()]:
            for camera in source.ego_mask.outlines:
                reply.ego_mask_metadata.add(
                    ego_mask_id=wire.EgoMaskId(camera_logical_id=camera, rig_config_id=name)
                )  # fmt: skip
        return reply

    # ---- images and scans

    def render_rgb(self, request: Any, active: IsActive) -> Any:
        (image,) = self._images([request], active)
        return wire.RGBRenderReturn(image_bytes=_or_raise(image))

    def batch_render_rgb(self, request: Any, active: IsActive) -> Any:
        """The images of a rig. Those that cannot be made have no `success`, and an `error_message` that begins with
        the status."""
        reply = wire.BatchRGBRenderReturn()
        images = self._images([item.request for item in request.items], active)
        for item, image in zip(request.items, images, strict=True):
            if isinstance(image, ServiceError):
                reply.items.add(camera_name=item.camera_name, success=False, error_message=f"{image.code}: {image}")
            else:
                result = wire.RGBRenderReturn(image_bytes=image)
                reply.items.add(camera_name=item.camera_name, result=result, success=True)
        return reply

    def render_lidar(self, request: Any, active: IsActive) -> Any:
        """One scan. Points are in the frame of the sensor at the end of the spin."""
        return self._scan(RequestReader(self._drives.place).scan(request), active)

    def render_aggregated(self, request: Any, active: IsActive) -> Any:
        """Images and scans; all of them, or the first error."""
        reader = RequestReader(self._drives.place)
        if len(request.lidar_requests) > MAX_REQUEST_SCANS:
            raise ServiceError(
                "RESOURCE_EXHAUSTED",
                f"the request asks for {len(request.lidar_requests)} scans; it may ask for {MAX_REQUEST_SCANS}",
            )
        scans = [reader.scan(own) for own in request.lidar_requests]
        images = [_or_raise(image) for image in self._images(request.rgb_requests, active)]
        return wire.AggregatedRenderReturn(
            rgb_returns=[wire.RGBRenderReturn(image_bytes=image) for image in images],
            lidar_returns=[self._scan(scan, active) for scan in scans],
        )

    def _images(self, messages: Sequence[Any], active: IsActive) -> list[Answered[bytes]]:
        """The images of requests; those of one world are rendered together, and all are encoded side by side."""
        reader = RequestReader(self._drives.place)
        read = [_attempt(partial(reader.image, message)) for message in messages]
        require_affordable(read, self.options.max_loaded)
        groups: dict[WorldKey, list[int]] = {}
        for number, one in enumerate(read):
            if isinstance(one, ImageRequest):
                groups.setdefault(one.world, []).append(number)
        pictures: dict[int, Answered[Picture]] = {i: own for i, own in enumerate(read) if isinstance(own, ServiceError)}
        if groups:
            with self._device(active):
                for numbers in groups.values():
                    own = [read[number] for number in numbers]
                    found = _attempt(partial(self._rendered, own))
                    each = [found] * len(own) if isinstance(found, ServiceError) else found
                    pictures.update(zip(numbers, each, strict=True))
        waiting = [self._encoder(pictures[i]).submit(self._encoded, read[i], pictures[i]) for i in range(len(read))]
        return [_attempt(future.result) for future in waiting]

    def _encoder(self, picture: Answered[Picture]) -> ThreadPoolExecutor:
        return self._device_encoder if isinstance(picture, Tensor) else self._encoders

    def _rendered(self, requests: Sequence[ImageRequest]) -> list[Picture]:
        """The images of requests of one world, rendered by the thread that uses the model."""
        loaded = self._drives.get(requests[0].world.scene_id)
        world = self._world(loaded, requests[0].world, requests[0].objects)
        views = world.render_placed([request.placed(world.time) for request in requests])
        colors = [view.rgb for view in views]
        assert all(color is not None for color in colors)
        pictures: list[Any] = [None] * len(requests)
        on_device = [self._on_device(request) for request in requests]
        for here, pixels_of in ((True, planes_on_device), (False, uint8_images)):
            own = [i for i, on in enumerate(on_device) if on == here]
            for i, pixels in zip(own, pixels_of([colors[i] for i in own]), strict=True):
                pictures[i] = pixels
        return pictures

    def _on_device(self, request: ImageRequest) -> bool:
        """Whether the device encodes an image, which is then changed no more."""
        is_jpeg = request.encoding.format == wire.ImageFormat.JPEG
        return self.options.jpeg == "device" and is_jpeg and request.mask_of is None

    def _encoded(self, request: Answered[ImageRequest], picture: Answered[Picture]) -> bytes:
        """An image as bytes, with the ego mask in black if it is wanted."""
        if isinstance(picture, ServiceError):
            raise picture
        assert isinstance(request, ImageRequest)
        if request.mask_of is not None:
            picture[self._mask(request)] = 0
        if isinstance(picture, Tensor):
            found = jpeg_on_device(picture, request.encoding.quality)
        else:
            found = encoded(picture, request.encoding)
        self.figures.encoded(wire.ImageFormat(request.encoding.format).name, len(found))
        return found

    def _mask(self, request: ImageRequest) -> np.ndarray:
        """The pixels of the vehicle's own body. Raises ServiceError (NOT_FOUND) where no mask is known."""
        assert request.mask_of is not None
        name = self._drives.name_of(request.world.scene_id)
        mask = self._sources[name].ego_mask
        if request.mask_of not in mask.outlines:
            known = ", ".join(mask.outlines) or "none"
            raise ServiceError(
                "NOT_FOUND", f"scene {name} has no ego mask of camera {request.mask_of[:80]!r}; it has: {known}"
            )
        return mask.pixels(request.mask_of, (request.camera.width, request.camera.height))

    def _scan(self, request: ScanRequest, active: IsActive) -> Any:
        with self._loaded(request.world.scene_id, active) as loaded:
            drive = loaded.drive
            lidar = request.lidar or next(iter(drive.lidars), None)
            if lidar is None:
                raise ServiceError(
                    "FAILED_PRECONDITION", f"{drive.where} has no LiDAR of its own; name one in lidar_config"
                )
            if not all("lidar_logits" in part.params for part in drive.model.parts):
                raise ServiceError(
                    "FAILED_PRECONDITION",
                    f"{drive.where} was trained without LiDAR: serve a method such as street_lidar",
                )
            world = self._world(loaded, request.world, request.objects)
            scan = world.scan(
                lidar, sensor_to_world=request.sensor_to_world, velocity=request.velocity, with_instance=False
            )
            return _scan_message(scan, request.end_to_world)

    # ---- the device

    def _world(self, loaded: LoadedDrive, key: WorldKey, objects: ListedObjects) -> WorldState:
        """The drive at the time of a frame, with the objects that a request lists."""
        time = loaded.seconds(key.times)
        as_recorded = not objects.ids and self.options.unlisted == "recorded"
        return loaded.drive.state(time, placements=None if as_recorded else objects.placements(loaded.actors))

    @contextmanager
    def _loaded(self, scene_id: str, active: IsActive) -> Iterator[LoadedDrive]:
        """A block that uses the model of a drive."""
        self._drives.name_of(scene_id)
        with self._device(active), as_service_errors():
            yield self._drives.get(scene_id)

    @contextmanager
    def _device(self, active: IsActive) -> Iterator[None]:
        """A block that alone uses a model. Raises ServiceError (CANCELLED) where the client waits no more."""
        with self.figures.waiting():
            self._lock.acquire()
        try:
            if not active():
                raise ServiceError("CANCELLED", "the client has gone")
            with self.figures.using_model():
                yield
        finally:
            self._lock.release()


def _attempt(work: Callable[[], Result]) -> Answered[Result]:
    """What `work` returns, or the ServiceError that it raises."""
    try:
        with as_service_errors():
            return work()
    except ServiceError as error:
        return error


def _trajectory(scene: Scene) -> Any:
    """The recorded path of the vehicle as a message, by the images of the first camera."""
    first = scene.frames[0].camera if scene.frames else None
    recordings = [frame for frame in scene.frames if frame.camera == first] or scene.sweeps
    stamps = sorted({int(recording.timestamp) for recording in recordings})
    path = recorded_ego(scene, first)(np.array([scene.seconds(stamp) for stamp in stamps]))
    poses = [wire.PoseAtTime(pose=pose_message(pose), timestamp_us=at) for at, pose in zip(stamps, path, strict=True)]
    return wire.Trajectory(poses=poses)


def _or_raise(answered: Answered[Result]) -> Result:
    if isinstance(answered, ServiceError):
        raise answered
    return answered


def _scan_message(scan: DriveScan, end_to_world: np.ndarray) -> Any:
    points = apply(inverse(end_to_world), scan.points()).astype("<f4")
    returned = scan.returned.cpu().numpy()
    intensities = scan.intensity.cpu().numpy()[returned].clip(0.0, 1.0).astype("<f4")
    return wire.LidarRenderReturn(
        point_xyzs=points.ravel(), point_intensities=intensities, num_points=len(points),
        point_xyzs_buffer=points.tobytes(), point_intensities_buffer=intensities.tobytes(),
    )  # fmt: skip
