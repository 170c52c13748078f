"""A drive at one time, whose objects can be moved one by one, as cameras and LiDARs see it."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import overload

import numpy as np
import torch
from jaxtyping import Int16
from torch import Tensor

from drivesplat.drive.cameras import AS_DRIVEN, GivenPose, Matrix, PlacedCamera, PoseableCamera, Vector
from drivesplat.drive.drive_view import DriveScan, DriveView, ObjectBox
from drivesplat.drive.lenses import resampled
from drivesplat.drive.lidars import PoseableLidar
from drivesplat.drive.world_actor import ActorsById, WorldActor
from drivesplat.editing.placed_model import PlacedModel, actor_placements
from drivesplat.editing.shown_objects import ShownObjects, box_of, seen_objects
from drivesplat.errors import RequestError, ResultError
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.scans import WITHOUT_LIDAR
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement
from drivesplat.model.view import View
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.tracks import Box
from drivesplat.trajectories.edited_actors import EditedActor

OUTPUTS = ("rgb", "depth", "alpha", "instance", "semantic", "valid", "boxes")
"""What `WorldState.render` can give."""
AnyCamera = str | PoseableCamera
"""The name of a recorded camera, or a camera of one's own."""


SKY = "sky"
"""The class of what no Gaussian shows."""
MAX_PIXELS = 16_777_216
"""Pixels that are rendered at once; larger images are rendered in bands of lines."""
INTERPOLATED = ("rgb", "alpha")
"""The outputs of a distorted camera that are interpolated between pixels."""


class Sensors(ABC):
    """The sensors of a drive, placed at a time: see `TrainedDrive`."""

    @abstractmethod
    def placed_camera(self, camera: AnyCamera, time: float, at: GivenPose = AS_DRIVEN) -> PlacedCamera:
        """A camera at a time."""

    @abstractmethod
    def placed_lidar(
        self, lidar: str | PoseableLidar, time: float, at: GivenPose = AS_DRIVEN
    ) -> tuple[RecordedScan, tuple[float, float]]:
        """The rays of a LiDAR at a time, and the spread of its beams in radians."""


@dataclass(frozen=True, eq=False)
class SampledWorld:
    """A drive at a `time`: the `actors` of the model with their places, and the objects that it shows in its `static`
    part. `as_recorded`: no object was moved, added or removed."""

    fixed: FixedModel
    time: float
    actors: tuple[WorldActor, ...]
    static: ShownObjects
    as_recorded: bool

    @cached_property
    def placed(self) -> PlacedModel:
        """The model with the actors at their places."""
        return PlacedModel(self.fixed, self.time, [actor.placement for actor in self.actors])

    @cached_property
    def shown(self) -> PlacedModel:
        """The model that images show: as recorded where nothing was changed, as films of the recorded drive do."""
        return PlacedModel(self.fixed, self.time) if self.as_recorded else self.placed

    @property
    def model(self) -> SplatModel:
        """The model, with objects as recorded."""
        return self.fixed.model

    @property
    def device(self) -> torch.device:
        """The device of the model."""
        return self.model.parts[0].params["means"].device

    @cached_property
    def classes(self) -> tuple[str, ...]:
        """The names of classes: the sky, the parts without objects, and the classes of objects."""
        known = {item.object_class.value for item in (*self.actors, *self.static.others)}
        return (SKY, *(part.name for part in self.model.parts if not part.has_objects), *sorted(known))

    def images(self, cameras: Sequence[PlacedCamera], outputs: Collection[str]) -> list[DriveView]:
        """What cameras see."""
        if "boxes" in outputs and any(placed.camera.distorted for placed in cameras):
            raise RequestError("boxes are those of a pinhole camera: leave them out for a distorted one")
        views = [placed.view(self.device) for placed in cameras]
        pinholes = [_pinholes(placed.camera, view) for placed, view in zip(cameras, views, strict=True)]
        shown = iter(self._tensors([pinhole for own in pinholes for pinhole in own], outputs))
        return [
            self._image(placed.camera, view, list(islice(shown, len(own))), outputs)
            for placed, view, own in zip(cameras, views, pinholes, strict=True)
        ]

    def _image(
        self, camera: PoseableCamera, view: View, shown: Sequence[dict[str, Tensor]], outputs: Collection[str]
    ) -> DriveView:
        """The image of a camera, of what its `_pinholes` show."""
        parts = {name: [own[name] for own in shown] for name in shown[0]}
        if camera.distorted:
            found = {
                name: resampled(camera.faces, own, name not in INTERPOLATED, name == "depth")
                for name, own in parts.items()
            }
        else:
            found = {name: torch.cat(own) if len(own) > 1 else own[0] for name, own in parts.items()}
        if "valid" in outputs:
            found["valid"] = torch.from_numpy(camera.uncovered()).to(self.device)
            if camera.distorted:
                found["valid"] &= torch.stack([face.shows for face in camera.faces]).any(dim=0).to(self.device)
        boxes = tuple(self._boxes(view)) if "boxes" in outputs else None
        return DriveView(self._ids, **found, boxes=boxes, classes=self.classes if "semantic" in outputs else ())

    def scan(self, sensor: RecordedScan, beam_spread: tuple[float, float], with_instance: bool) -> DriveScan:
        """What the rays of a scan return. `beam_spread` in radians."""
        view = self.placed.fixed.scan_view(sensor, beam_spread)
        picture = self.placed.scan(view)
        measured = torch.from_numpy(sensor.measured).to(self.device)
        returned = (picture.returned > 0.5) & (picture.range > 0.0) & measured
        return DriveScan(
            self._ids, sensor, picture.range, picture.returned, returned, picture.intensity,
            torch.where(picture.range > 0.0, self.placed.objects_met(view), -1) if with_instance else None,
        )  # fmt: skip

    @property
    def _ids(self) -> tuple[str, ...]:
        return tuple(actor.id for actor in self.actors)

    def _tensors(self, views: Sequence[View], outputs: Collection[str]) -> list[dict[str, Tensor]]:
        """The outputs of each view, but for `valid` and boxes."""
        makers = {"depth": self.shown.surface_depth, "instance": self.placed.objects_in, "semantic": self._classes}
        found = [{name: make(view) for name, make in makers.items() if name in outputs} for view in views]
        if "rgb" in outputs or "alpha" in outputs:
            for own, picture in zip(found, self.shown.render_all(views), strict=True):
                own |= {"rgb": picture.image, "alpha": picture.alpha}
        return [{name: own[name] for name in outputs if name in own} for own in found]

    def _classes(self, view: View) -> Int16[Tensor, "h w"]:
        gaussians = self.placed.gaussians_in(view)
        number = {name: i for i, name in enumerate(self.classes)}
        rows = torch.cat(
            [
                torch.full((len(own),), number.get(part.name, -1), dtype=torch.int16, device=self.device)
                for part, own in zip(self.model.parts, self.placed.sets_in(view), strict=True)
            ]
        )
        if gaussians.placement is not None:
            of_actors = [number[actor.object_class.value] for actor in self.actors]
            own = torch.tensor([*of_actors, -1], dtype=torch.int16, device=self.device)[gaussians.placement]
            rows = torch.where(gaussians.placement >= 0, own, rows)
        for item, shown in self.static.rows_of_others(view, self.placed):
            rows[shown] = number[item.object_class.value]
        return self.model.strongest(gaussians, rows, view).clamp(min=0)

    def _boxes(self, view: View) -> Iterator[ObjectBox]:
        boxes = [Box(a.id, ObjectClass.VEHICLE, a.category, a.size, a.pose, 0.0, 0) for a in self.actors]
        seen = seen_objects(self.placed, boxes, view)
        known = {item.id: item for item in self.static.others}
        others = self.static.others_in(view, self.placed)
        boxes += [box_of(known[item.id], view.time) for item in others]
        for box, item in zip(boxes, [*seen, *others], strict=True):
            if item is not None:
                own = box.category, box.size.copy(), box.object_to_world
                yield ObjectBox(item.id, *own, item.corners, item.visible)


def _pinholes(camera: PoseableCamera, view: View) -> list[View]:
    """The pinhole views that make up the view of a camera: its faces where it is distorted, otherwise bands of lines
    that are not too large."""
    if camera.distorted:
        return [face.view(view) for face in camera.faces]
    rows = max(1, MAX_PIXELS // view.width)
    if rows >= view.height:
        return [view]
    tops = range(0, view.height, rows)
    return [view.cropped(0, top, view.width, min(rows, view.height - top)) for top in tops]


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
        fixed: FixedModel,
        actors: Sequence[EditedActor],
        static: ShownObjects,
        sensors: Sensors,
        time: float,
        as_recorded: bool,
        placements: Mapping[str, ActorPlacement] | None = None,
    ):
        """`actors` of the drive at all times; `static` knows the objects that the model has no Gaussians of. With
        `placements`, the actors of these ids are present, at these places, and no others."""
        self.time, now = time, np.array([time])
        self._fixed, self._static = fixed, static
        self._sensors, self._as_recorded = sensors, as_recorded
        self._taken = {item.id for item in (*actors, *static.others)}
        absent = {item.id: "is not there at this time" for item in actors}
        fixed = {item.id: "is not editable (the table `actors` of the drive says why)" for item in static.others}
        if placements is None:
            present = [actor for actor in actors if actor.present(now)[0]]
            (placed,) = actor_placements(present, now)
        else:
            present = [actor for actor in actors if actor.id in placements]
            placed = [placements[actor.id] for actor in present]
        own = zip(present, placed, strict=True)
        self.actors = ActorsById(
            {actor.id: WorldActor(actor, placement, time) for actor, placement in own}, {**absent, **fixed}
        )

    def remove(self, name: str) -> None:
        """Removes an object, named as in `actors`."""
        gone = self.actors[name].id
        self.actors = self.actors.without(gone)
        self._as_recorded = False

    def add(self, source: str, name: str, object_to_world: Matrix) -> WorldActor:
        """Adds a copy `name` of the object `source` at a pose (4, 4)."""
        if not name or name in {*self._taken, *self.actors}:
            raise RequestError(f"a copy cannot be named {name!r}: choose a name that no other object has")
        copy = self.actors[source].copied(name)
        copy.pose = object_to_world
        self.actors = self.actors.with_one(copy)
        return copy

    def placed(self) -> PlacedModel:
        """The model with the objects at their places, by their order in `actors`."""
        return self._sampled().placed

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
            velocity: Linear (m/s), then angular velocity (rad/s), which rolling shutters see, of what the pose is given
                for, or else of the vehicle, along its own axes. None: at rest where a pose is given, otherwise as the
                vehicle drives.
            outputs: Names from OUTPUTS.

        Raises RequestError for an unknown camera or output, an invalid pose or velocity, and for two poses; ResultError
        for images that contain NaN (when `DriveView.image` is read), DeviceError where memory is exhausted.
        """
        outputs = (outputs,) if isinstance(outputs, str) else outputs
        if unknown := [name for name in outputs if name not in OUTPUTS]:
            raise RequestError(f"there is no output {unknown[0]!r}; there are: {', '.join(OUTPUTS)}")
        several = not isinstance(camera, str | PoseableCamera)
        cameras = list(camera) if several else [camera]
        if several and camera_to_world is not None:
            raise RequestError("several cameras are placed by one ego_to_world: camera_to_world is for one camera")
        at = GivenPose.checked("the camera", ego_to_world, camera_to_world, velocity)
        views = self.render_placed([self._sensors.placed_camera(one, self.time, at) for one in cameras], outputs)
        return views if several else views[0]

    @torch.no_grad()
    def render_placed(self, cameras: Sequence[PlacedCamera], outputs: Sequence[str] = ("rgb",)) -> list[DriveView]:
        """What cameras see, each at a pose and a velocity of its own. Their time must be this world's; the Gaussians
        are placed once for all of them. Raises as `render`."""
        if other := [camera.time for camera in cameras if camera.time != self.time]:
            raise RequestError(f"a camera at {other[0]:g} s cannot show a world at {self.time:g} s")
        world = self._sampled()
        with explain_out_of_memory(lambda: len(self._fixed.model)):
            return world.images(cameras, outputs)

    @torch.no_grad()
    def scan(
        self,
        lidar: str | PoseableLidar,
        *,
        ego_to_world: Matrix | None = None,
        sensor_to_world: Matrix | None = None,
        velocity: Vector | None = None,
        with_instance: bool = True,
    ) -> DriveScan:
        """What a LiDAR measures in a revolution about this time.

        Args:
            lidar: The name of a recorded LiDAR, whose rays of the scan nearest in time are fired, or a LiDAR of one's
                own.
            ego_to_world: Pose (4, 4) of the vehicle that carries it; None: its pose in the drive at this time.
            sensor_to_world: Pose (4, 4) of the LiDAR itself, in place of a vehicle's.
            velocity: As in `render`; the sensor moves during the revolution.
            with_instance: Whether to tell which object each ray meets, which takes about as long as the rest.

        Raises RequestError as `render`, ResultError for a model that was trained without LiDAR.
        """
        at = GivenPose.checked("the LiDAR", ego_to_world, sensor_to_world, velocity)
        if any("lidar_logits" not in part.params for part in self._fixed.model.parts):
            raise ResultError(WITHOUT_LIDAR)
        sensor, spread = self._sensors.placed_lidar(lidar, self.time, at)
        with explain_out_of_memory(lambda: len(self._fixed.model)):
            return self._sampled().scan(sensor, spread, with_instance)

    def _sampled(self) -> SampledWorld:
        actors = tuple(self.actors.values())
        as_recorded = self._as_recorded and not any(actor.changed for actor in actors)
        return SampledWorld(self._fixed, self.time, actors, self._static, as_recorded)
