"""The objects of a drive at one time, which can be moved one by one."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from drivesplat.drive.cameras import Matrix, Vector, require_pose, require_vector
from drivesplat.errors import UnknownObjectError
from drivesplat.lidar.moved_sensor import steady_motion
from drivesplat.model.states import ActorPlacement
from drivesplat.scene.rigid import inverse
from drivesplat.scene.tracks import matching_ids
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.motion import HALF_STEP


class WorldActor:
    """An object of a world: its `id`, its `object_class`, and the `category` of the dataset."""

    def __init__(self, actor: EditedActor, placement: ActorPlacement, time: float):
        self.id, self.object_class, self.category = actor.id, actor.object_class, actor.category
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
        move the object, whose limbs, colours and velocity along its own axes stay those of the time. Raises
        RequestError for an invalid pose."""
        placed = self._placement.object_to_world
        return self._actor.poses(np.array([self._time]))[0] if placed is None else placed.copy()

    @pose.setter
    def pose(self, object_to_world: Matrix) -> None:
        pose = require_pose(object_to_world, f"object {self.id}")
        moved, around = pose @ inverse(self.pose), self._placement.around
        if around is None:
            before, after = self._actor.poses(np.array([self._time - HALF_STEP, self._time + HALF_STEP]))
            around = before, after
        self._placement = replace(self._placement, object_to_world=pose, around=(moved @ around[0], moved @ around[1]))
        self.changed = True

    def set_motion(self, object_to_world: Matrix, velocity: Vector) -> None:
        """Moves the object to a pose (4, 4), at a `velocity` (6,) along its own axes: linear (m/s), then angular
        (rad/s). Rolling shutters and LiDARs see it move."""
        pose = require_pose(object_to_world, f"object {self.id}")
        linear, angular = require_vector(velocity, 6, f"the velocity of object {self.id}").reshape(2, 3)
        before, after = steady_motion(pose, linear, angular)(np.array([-HALF_STEP, HALF_STEP]))
        self._placement = replace(self._placement, object_to_world=pose, around=(before, after))
        self.changed = True

    @property
    def source(self) -> str:
        """The id of the track, or the name of the asset, whose Gaussians it has."""
        return self._actor.source

    def copied(self, name: str) -> "WorldActor":
        """Another object with the same Gaussians."""
        return WorldActor(replace(self._actor, id=name), self._placement, self._time)


class ActorsById(Mapping[str, WorldActor]):
    """Objects by their ids, or by the first characters of an id that only one begins with. `missing` says why other
    objects are not among them. Raises UnknownObjectError, which is a KeyError, for any other name."""

    def __init__(self, actors: Mapping[str, WorldActor], missing: Mapping[str, str]):
        self._actors, self._missing = dict(actors), dict(missing)

    def __repr__(self) -> str:
        return f"<objects {', '.join(self) or 'none'}>"

    def __getitem__(self, name: str) -> WorldActor:
        found = matching_ids(name, self._actors) if isinstance(name, str) and name else []
        if len(found) == 1:
            return self._actors[found[0]]
        there = f"there are: {', '.join(self) or 'none'}"
        known = matching_ids(name, self._missing) if isinstance(name, str) and name and not found else []
        if len(known) == 1:
            raise UnknownObjectError(f"object {known[0]} {self._missing[known[0]]}; {there}")
        count = f"{len(found)} objects have" if found else "no object has"
        raise UnknownObjectError(f"{count} an id starting with {name!r}; {there}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._actors)

    def __len__(self) -> int:
        return len(self._actors)

    def without(self, name: str) -> "ActorsById":
        """The objects but for the one with this id."""
        kept = {known: actor for known, actor in self._actors.items() if known != name}
        return ActorsById(kept, {**self._missing, name: "has been removed"})

    def with_one(self, actor: WorldActor) -> "ActorsById":
        """The objects and another one."""
        return ActorsById({**self._actors, actor.id: actor}, self._missing)
