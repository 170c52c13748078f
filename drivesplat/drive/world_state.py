"""A drive at one time, whose objects can be moved one by one, as cameras and LiDARs see it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import overload

import numpy as np
import torch

from drivesplat.drive.cameras import Matrix, PlacedCamera, PoseableCamera, Vector
from drivesplat.drive.drive_scan import DriveScan
from drivesplat.drive.drive_view import DriveView
from drivesplat.drive.lidars import PoseableLidar
from drivesplat.drive.sampled_world import SampledWorld
from drivesplat.drive.world_actor import ActorsById, WorldActor
from drivesplat.editing.actors import actor_placements
from drivesplat.editing.shown_objects import ShownObjects
from drivesplat.errors import RequestError
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.trajectories.edited_actors import EditedActor

OUTPUTS = ("rgb", "depth", "alpha", "instance", "semantic", "valid", "boxes")
"""What `WorldState.render` can give."""
AnyCamera = str | PoseableCamera
"""The name of a recorded camera, or a camera of one's own."""


class Sensors(ABC):
    """The sensors of a drive, placed at a time: see `TrainedDrive`."""

    @abstractmethod
    def placed_camera(
        self,
        camera: AnyCamera,
        time: float,
        ego_to_world: Matrix | None = None,
        camera_to_world: Matrix | None = None,
        velocity: Vector | None = None,
    ) -> PlacedCamera:
        """A camera at a time."""

    @abstractmethod
    def placed_lidar(
        self,
        lidar: str | PoseableLidar,
        time: float,
        ego_to_world: Matrix | None = None,
        sensor_to_world: Matrix | None = None,
        velocity: Vector | None = None,
    ) -> tuple[RecordedScan, tuple[float, float]]:
        """The rays of a LiDAR at a time, and the spread of its beams in radians."""


class WorldState:
    """A drive at one time, as `TrainedDrive.state` gives it, to be changed and rendered: `actors` are the objects that
    are present and of which the model has Gaussians, by id.

    >>> world = drivesplat.open("results/demo/street").state(time=4.2)
    >>> pose = world.actors["bf53"].pose
    >>> pose[:3, 3] += 2.0 * pose[:3, 1]  # two metres to its left
    >>> world.actors["bf53"].pose = pose
    >>> world.remove("cbdd")
    >>> image = world.render("CAM_FRONT").image
    """

    def __init__(
        self,
        model: SplatModel,
        actors: Sequence[EditedActor],
        static: ShownObjects,
        class_of: Mapping[str, ObjectClass],
        sensors: Sensors,
        time: float,
        as_recorded: bool,
    ):
        """`actors` of the drive at all times; `static` knows the objects that the model has no Gaussians of; `class_of`
        are the classes of tracks by id."""
        self.time, now = time, np.array([time])
        self._model, self._static, self._class_of = model, static, class_of
        self._sensors, self._as_recorded = sensors, as_recorded
        self._taken = {item.id for item in (*actors, *static.others)}
        present = [actor for actor in actors if actor.present(now)[0]]
        (placed,) = actor_placements(present, now)
        own = zip(present, placed, strict=True)
        self.actors = ActorsById({actor.id: WorldActor(actor, placement, time) for actor, placement in own})

    def remove(self, name: str) -> None:
        """Removes an object, named as in `actors`."""
        gone = self.actors[name].id
        self.actors = ActorsById({known: actor for known, actor in self.actors.items() if known != gone})
        self._as_recorded = False

    def add(self, source: str, name: str, object_to_world: Matrix) -> WorldActor:
        """Adds a copy `name` of the object `source` at a pose (4, 4)."""
        if not name or name in {*self._taken, *self.actors}:
            raise RequestError(f"a copy cannot be named {name!r}: choose a name that no other object has")
        copy = self.actors[source].copied(name)
        copy.pose = object_to_world
        self.actors = ActorsById({**self.actors, name: copy})
        return copy

    @overload
    def render(
        self,
        camera: AnyCamera,
        *,
        ego_to_world: Matrix | None = None,
        camera_to_world: Matrix | None = None,
        velocity: Vector | None = None,
        outputs: Sequence[str] = ("rgb",),
    ) -> DriveView: ...

    @overload
    def render(
        self,
        camera: Sequence[AnyCamera],
        *,
        ego_to_world: Matrix | None = None,
        velocity: Vector | None = None,
        outputs: Sequence[str] = ("rgb",),
    ) -> list[DriveView]: ...

    @torch.no_grad()
    def render(
        self,
        camera: AnyCamera | Sequence[AnyCamera],
        *,
        ego_to_world: Matrix | None = None,
        camera_to_world: Matrix | None = None,
        velocity: Vector | None = None,
        outputs: Sequence[str] = ("rgb",),
    ) -> DriveView | list[DriveView]:
        """What a camera sees, or each of several cameras of one vehicle.

        Args:
            camera: The name of a recorded camera, a camera of one's own, or a list of these. The Gaussians are placed
                once for all of a list.
            ego_to_world: Pose (4, 4) of the vehicle that carries the camera; None: its pose in the drive at this time.
            camera_to_world: Pose (4, 4) of the camera itself, in place of a vehicle's; for one camera.
            velocity: Linear (m/s), then angular velocity (rad/s) along the axes of what the pose is given for, which
                rolling shutters see. None: at rest where a pose is given, otherwise as the vehicle drives.
            outputs: Names from OUTPUTS.

        Raises RequestError for an unknown camera or output, an invalid pose or velocity, and for two poses; ResultError
        for images that contain NaN (when `DriveView.image` is read), DeviceError where memory is exhausted.
        """
        if unknown := [name for name in outputs if name not in OUTPUTS]:
            raise RequestError(f"there is no output {unknown[0]!r}; there are: {', '.join(OUTPUTS)}")
        several = not isinstance(camera, str | PoseableCamera)
        cameras = list(camera) if several else [camera]
        if several and camera_to_world is not None:
            raise RequestError("several cameras are placed by one ego_to_world: camera_to_world is for one camera")
        at = ego_to_world, camera_to_world, velocity
        placed = [self._sensors.placed_camera(one, self.time, *at) for one in cameras]
        world = self._sampled()
        with explain_out_of_memory(lambda: len(self._model)):
            views = [world.image(one, outputs) for one in placed]
        return views if several else views[0]

    @torch.no_grad()
    def scan(
        self,
        lidar: str | PoseableLidar,
        *,
        ego_to_world: Matrix | None = None,
        sensor_to_world: Matrix | None = None,
        velocity: Vector | None = None,
    ) -> DriveScan:
        """What a LiDAR measures in a revolution about this time.

        Args:
            lidar: The name of a recorded LiDAR, whose rays of the scan nearest in time are fired, or a LiDAR of one's
                own.
            ego_to_world: Pose (4, 4) of the vehicle that carries it; None: its pose in the drive at this time.
            sensor_to_world: Pose (4, 4) of the LiDAR itself, in place of a vehicle's.
            velocity: As in `render`; the sensor moves during the revolution.

        Raises RequestError as `render`, ResultError for a model that was trained without LiDAR.
        """
        sensor, spread = self._sensors.placed_lidar(lidar, self.time, ego_to_world, sensor_to_world, velocity)
        with explain_out_of_memory(lambda: len(self._model)):
            return self._sampled().scan(sensor, spread)

    def _sampled(self) -> SampledWorld:
        actors = tuple(self.actors.values())
        as_recorded = self._as_recorded and not any(actor.changed for actor in actors)
        return SampledWorld(self._model, self.time, actors, self._static, self._class_of, as_recorded)
