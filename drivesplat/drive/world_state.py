"""A drive at one time, whose objects can be moved one by one."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from drivesplat.drive.cameras import Matrix, PoseableCamera, require_pose
from drivesplat.drive.drive_view import DriveView, ObjectBox
from drivesplat.editing.actors import actor_placements
from drivesplat.editing.shown_objects import ShownObjects, box_of, seen_object
from drivesplat.errors import RequestError, UnknownObjectError
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.actor_placements import ActorPlacement
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.groups import strongest_group
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import Want
from drivesplat.model.view import View
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.tracks import Box, matching_ids
from drivesplat.trajectories.edited_actors import EditedActor

ViewOf = Callable[[str | PoseableCamera, float, Matrix | None, Matrix | None], View]
"""The view of a camera at a time, with the pose of the vehicle or of the camera, if given."""

OUTPUTS = ("rgb", "depth", "alpha", "instance", "boxes")
"""What `WorldState.render` can give."""


class WorldActor:
    """An object of a world: `id` and `category` of the dataset."""

    def __init__(self, actor: EditedActor, placement: ActorPlacement, time: float):
        self.id, self.category = actor.id, actor.category
        self._actor, self._placement, self._time = actor, placement, time
        self.changed = False

    @property
    def placement(self) -> ActorPlacement:
        """Where and how its Gaussians are rendered."""
        return self._placement

    @property
    def size(self) -> np.ndarray:
        """Length, width and height in metres, a copy."""
        return self._actor.size.copy()

    @property
    def pose(self) -> np.ndarray:
        """Object to world (4, 4), at the centre of its box, x forward, y left, z up. It is a copy: assign a pose to
        move the object, whose limbs and colours stay those of the time. Raises RequestError for an invalid pose."""
        placed = self._placement.object_to_world
        return self._actor.poses(np.array([self._time]))[0] if placed is None else placed.copy()

    @pose.setter
    def pose(self, object_to_world: Matrix) -> None:
        pose = require_pose(object_to_world, f"object {self.id}")
        self._placement = replace(self._placement, object_to_world=pose, around=None)
        self.changed = True

    def copied(self, name: str) -> "WorldActor":
        """Another object with the same Gaussians."""
        return WorldActor(replace(self._actor, id=name), self._placement, self._time)


class ActorsById(Mapping[str, WorldActor]):
    """Objects by their ids, or by the first characters of an id that only one begins with. Raises UnknownObjectError,
    which is a KeyError, for any other name."""

    def __init__(self, actors: Mapping[str, WorldActor]):
        self._actors = dict(actors)

    def __getitem__(self, name: str) -> WorldActor:
        found = matching_ids(name, self._actors)
        if len(found) != 1 or not name:
            count = "no object has" if not found else f"{len(found)} objects have"
            raise UnknownObjectError(f"{count} an id starting with {name!r}; there are: {', '.join(self) or 'none'}")
        return self._actors[found[0]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._actors)

    def __len__(self) -> int:
        return len(self._actors)


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
        view_of: ViewOf,
        time: float,
        as_recorded: bool,
    ):
        """`actors` of the drive at all times; `static` knows the objects that the model has no Gaussians of."""
        self.time, now = time, np.array([time])
        self._model, self._static, self._view_of, self._as_recorded = model, static, view_of, as_recorded
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

    @torch.no_grad()
    def render(
        self,
        camera: str | PoseableCamera,
        *,
        ego_to_world: Matrix | None = None,
        camera_to_world: Matrix | None = None,
        outputs: Sequence[str] = ("rgb",),
    ) -> DriveView:
        """What a camera sees.

        Args:
            camera: The name of a recorded camera, or a camera of one's own.
            ego_to_world: Pose (4, 4) of the vehicle that carries the camera; None: that of the drive at this time.
            camera_to_world: Pose (4, 4) of the camera itself, in place of a vehicle's.
            outputs: Names from OUTPUTS.

        Raises RequestError for an unknown camera or output, an invalid pose, and for two poses; ResultError for
        images that contain NaN (when `DriveView.image` is read), DeviceError where memory is exhausted.
        """
        if unknown := [name for name in outputs if name not in OUTPUTS]:
            raise RequestError(f"there is no output {unknown[0]!r}; there are: {', '.join(OUTPUTS)}")
        view = self._view_of(camera, self.time, ego_to_world, camera_to_world)
        with explain_out_of_memory(lambda: len(self._model)):
            return self._rendered(view, outputs)

    def _rendered(self, view: View, outputs: Collection[str]) -> DriveView:
        model, actors = self._model, tuple(self.actors.values())
        as_recorded = self._as_recorded and not any(actor.changed for actor in actors)
        placed = None
        if "instance" in outputs or not (as_recorded or set(outputs) <= {"boxes"}):
            placed = model.at(view.time, Want(placements=tuple(actor.placement for actor in actors)))
        gaussians = None if as_recorded else placed
        picture = surfaces = None
        if "rgb" in outputs or "alpha" in outputs:
            picture = model.render(view, gaussians=gaussians)
        if "depth" in outputs:
            surfaces = model.render(view, gaussians=gaussians, with_surface_depth=True).surface_depth
        return DriveView(
            tuple(self.actors),
            picture.image if picture is not None and "rgb" in outputs else None,
            surfaces,
            picture.alpha if picture is not None and "alpha" in outputs else None,
            self._instances(view, placed) if placed is not None and "instance" in outputs else None,
            tuple(self._boxes(view)) if "boxes" in outputs else None,
        )

    def _instances(self, view: View, gaussians: Gaussians) -> Tensor:
        if gaussians.placement is None:
            return torch.full((view.height, view.width), -1, dtype=torch.int16, device=view.K.device)

        def composited(shares: Tensor) -> Tensor:
            return self._model.composited(gaussians, shares.to(gaussians.means), view).image.squeeze(0)

        sky = 1.0 - self._model.composited(gaussians, gaussians.means.new_ones(len(gaussians), 1), view).alpha
        return strongest_group(gaussians.placement, composited, sky.squeeze((0, 3))).to(torch.int16)

    def _boxes(self, view: View) -> Iterator[ObjectBox]:
        model, actors = self._model, tuple(self.actors.values())
        want = Want(colors=False, placements=tuple(actor.placement for actor in actors))
        sets = model.sample(model.states(view.time, want), want)
        gaussians = concatenate(sets)
        boxes = [Box(a.id, ObjectClass.VEHICLE, a.category, a.size, a.pose, 0.0, 0) for a in actors]
        seen = [seen_object(model, gaussians, i, box, view) for i, box in enumerate(boxes)]
        known = {item.id: item for item in self._static.others}
        others = self._static.others_in(view, sets, gaussians)
        boxes += [box_of(known[item.id], view.time) for item in others]
        for box, item in zip(boxes, [*seen, *others], strict=True):
            if item is not None:
                own = box.category, box.size.copy(), box.object_to_world
                yield ObjectBox(item.id, *own, item.corners, item.visible)
