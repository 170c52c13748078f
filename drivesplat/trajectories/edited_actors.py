"""The actors of an edited drive: the recorded actors after every step of an edit."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.errors import ConfigError
from drivesplat.scene.light import Shade
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.track_references import why_fixed
from drivesplat.scene.tracks import matching_ids, short_ids
from drivesplat.settings.edit import (
    Duplicate,
    Edit,
    Insert,
    Place,
    Recolour,
    Rescale,
    Reverse,
    Shift,
    Speed,
    Step,
    Stop,
    Swap,
)  # fmt: skip
from drivesplat.trajectories.actor_path import ActorPath, recorded_path
from drivesplat.trajectories.motion import Motion
from drivesplat.trajectories.steps import (
    apply_duplicate,
    apply_reverse,
    apply_shift,
    apply_speed,
    apply_stop,
    placed_motion,
)

MIN_DISTANCE = 0.5
"""Metres; an actor that moves less counts as standing, since annotations are noisy."""
LOOKAHEAD = 60.0
"""Seconds past the end of a track in which that distance counts."""
ORIGIN = np.eye(4)[None]
"""The ego pose of a drive that begins at the world's origin."""
GREY_AXIS = np.full(3, 1.0 / np.sqrt(3.0))
"""The direction of greys."""
TO_GREY = np.full((3, 3), 1.0 / 3.0)
"""Maps a colour to the grey of its mean."""


SPEED_STEP = 0.1
"""Seconds over which the speed on a path is measured."""
MAX_SPEED = {
    ObjectClass.PEDESTRIAN: 8.0,
    ObjectClass.ANIMAL: 20.0,
    ObjectClass.BICYCLE: 20.0,
    ObjectClass.RIDER: 20.0,
}
"""The speed in m/s that an inserted object of a class may have."""
MAX_SPEED_OF_VEHICLES = 90.0
"""That of other classes."""


@dataclass(frozen=True)
class Insertable:
    """What a step that inserts an asset needs of it: its class and the dataset's own category, `size` (3,) in metres,
    and the directions from which it was `seen`, radians to the left of its front."""

    object_class: ObjectClass
    category: str
    size: np.ndarray
    seen: np.ndarray


NOTHING: Mapping[str, Insertable] = MappingProxyType({})


@dataclass(frozen=True)
class EditedActor:
    """An actor of an edited drive: `id` is a track's or the name of a duplicate. It has the Gaussians of the track
    `source`, scaled by `scale` about the box centre to `size` (3,): length, width, height in metres, their
    RGB colours mapped by `color_matrix` (3, 3; None: as trained), and a gait that is ahead by `phase` cycles. Unless
    `edited` it is as recorded. An inserted asset has its own name as its source, and `seen`: the directions from which
    its Gaussians were seen, radians to the left of its front (None: as the track `source` was). With a `shade` it
    darkens the ground."""

    id: str
    source: str
    scale: float
    object_class: ObjectClass
    category: str
    size: np.ndarray
    edited: bool
    path: ActorPath = field(repr=False)
    color_matrix: np.ndarray | None = None
    phase: float = 0.0
    seen: np.ndarray | None = None
    shade: Shade | None = None

    @classmethod
    def recorded(
        cls, id: str, object_class: ObjectClass, category: str, size: np.ndarray, motion: Motion
    ) -> "EditedActor":
        """An actor before any edit."""
        return cls(id, id, 1.0, object_class, category, size, False, recorded_path(motion, float(size[2])))

    def present(self, times: np.ndarray) -> np.ndarray:
        """Whether the actor is present at `times` (n,) in film seconds: (n,) bool."""
        return self.path.present(np.asarray(times, dtype=np.float64))

    def poses(self, times: np.ndarray) -> np.ndarray:
        """Object to world (n, 4, 4) at `times` (n,) in film seconds, at the centre of the scaled box."""
        times = np.asarray(times, dtype=np.float64)
        if not self.edited:
            return self.path.trajectory.motion.poses(times)
        return self.path.poses(times, float(self.size[2]))

    def walked(self, times: np.ndarray) -> np.ndarray:
        """The distance (n,) in metres by which its limbs have advanced at `times` (n,) in film seconds."""
        return self.path.walked(np.asarray(times, dtype=np.float64))


def edited_actors(
    actors: Sequence[EditedActor], edit: Edit, where: str, other_ids: Collection[str] = (),
    ego_to_world: np.ndarray = ORIGIN, insertable: Mapping[str, Insertable] = NOTHING,
) -> list[EditedActor]:  # fmt: skip
    """The recorded `actors` after all steps of an edit: in their order without the removed ones, then the duplicates
    and the inserted ones.

    `other_ids` are those of tracks that cannot be edited; no duplicate may have one. `ego_to_world` (n, 4, 4) are the
    ego poses of the drive, for steps that place an object; `insertable` has the assets of steps that insert one, by
    their names there. Raises ConfigError, one line that starts with `where` (the scene and the edit), if a step names
    an unknown track, changes nothing or contradicts an earlier step.
    """
    state = _EditState({actor.id: actor for actor in actors}, {}, frozenset(other_ids), ego_to_world, insertable)
    for number, step in enumerate(edit.steps, start=1):
        try:
            state = _after_step(state, step, number)
        except _StepError as error:
            raise ConfigError(f"{where}, step {number} ({step.kind}): {error}") from None
    return list(state.actors.values())


class _StepError(Exception):
    """The problem with a step, without its number."""


@dataclass(frozen=True)
class _EditState:
    """The actors after some steps by id; the removed ones by id, with the number of the step that removed them; ids of
    other tracks; the ego poses (n, 4, 4); what can be inserted."""

    actors: dict[str, EditedActor]
    removed: dict[str, tuple[int, EditedActor]]
    other_ids: frozenset[str]
    ego_to_world: np.ndarray
    insertable: Mapping[str, Insertable]

    def find(self, name: str, also_removed: bool = False) -> EditedActor:
        """The actor with that id, or the only one whose id starts with it; perhaps `also_removed` ones."""
        known = [*self.actors, *self.removed]
        found = matching_ids(name, known)
        short = short_ids(known)
        remaining = ", ".join(short[other] for other in self.actors) or "none"
        if not found:
            fixed = why_fixed(name, self.other_ids)
            raise _StepError(f"no editable track has an id starting with {name!r}; editable tracks: {remaining}{fixed}")
        if len(found) > 1:
            matches = ", ".join(short[other] for other in found)
            raise _StepError(f"{len(found)} tracks have ids starting with {name!r}: {matches}; give more characters")
        if found[0] in self.removed:
            number, actor = self.removed[found[0]]
            if also_removed:
                return actor
            raise _StepError(f"track {short[found[0]]} was removed by step {number}; remaining tracks: {remaining}")
        return self.actors[found[0]]

    def with_actors(self, *actors: EditedActor) -> "_EditState":
        """The state with these actors replaced or added."""
        return replace(self, actors=self.actors | {actor.id: actor for actor in actors})

    def without(self, actor: EditedActor, number: int) -> "_EditState":
        """The state after step `number` has removed an actor."""
        remaining = {name: other for name, other in self.actors.items() if name != actor.id}
        return replace(self, actors=remaining, removed=self.removed | {actor.id: (number, actor)})


def _after_step(state: _EditState, step: Step, number: int) -> _EditState:
    change = step.change
    if step.kind == "ego":
        return state
    if isinstance(change, Insert):
        return state.with_actors(_inserted(state, change))
    actor = state.find(change.track, also_removed=step.kind == "place")
    match change:
        case Swap():
            other = state.find(change.other)
            if other.id == actor.id:
                raise _StepError(f"{change.track!r} and {change.other!r} are the same track; name two tracks")
            here, there = replace(actor, path=other.path, edited=True), replace(other, path=actor.path, edited=True)
            return state.with_actors(here, there)
        case Duplicate():
            return _copied(state, actor, change, apply_duplicate(actor.path, change))
        case Place():
            height = float(actor.size[2])
            path = recorded_path(placed_motion(change.path, state.ego_to_world, height, change.yaw), height)
            return _copied(state, actor, change, path)
        case Rescale():
            scale, size = actor.scale * change.factor, actor.size * change.factor
            return state.with_actors(replace(actor, scale=scale, size=size, edited=True))
        case Recolour():
            matrix = color_matrix(change)
            before = np.eye(3) if actor.color_matrix is None else actor.color_matrix
            return state.with_actors(replace(actor, color_matrix=matrix @ before, edited=True))
        case Speed() | Stop() | Reverse() | Shift():
            return state.with_actors(replace(actor, path=_changed_path(actor.path, change), edited=True))
        case _:
            return state.without(actor, number)


def _changed_path(path: ActorPath, change: Speed | Stop | Reverse | Shift) -> ActorPath:
    match change:
        case Speed():
            _require_present(path, change.start, "start", may_precede=True)
            begin = max(path.begin, change.start or 0.0)
            if change.factor is not None:
                first, last = path.distance(np.array([begin, max(begin, path.end) + LOOKAHEAD]))
                if abs(last - first) < MIN_DISTANCE:
                    raise _StepError(f"the track stands from {begin:.2f} s on, where 'factor' has no effect; use 'to'")
            return apply_speed(path, change)
        case Stop():
            _require_present(path, change.at, "at", may_precede=False)
            return apply_stop(path, change)
        case Reverse():
            return apply_reverse(path, change)
        case Shift():
            _require_present(path, change.start, "start", may_precede=True)
            return apply_shift(path, change)


def _require_present(path: ActorPath, second: float | None, key: str, may_precede: bool) -> None:
    """A change after the track has no effect; one before it has, if it `may_precede` the track."""
    if second is None or bool(path.present(np.array([second]))[0]):
        return
    if second <= path.end and (may_precede or second >= path.begin):
        return
    problem = "ends before" if second > path.end else "begins after"
    raise _StepError(
        f"the track {problem} {key!r} ({second:g} s): it was recorded from {path.begin:.2f} to {path.end:.2f} s"
    )


def _inserted(state: _EditState, change: Insert) -> EditedActor:
    """The object that a step inserts."""
    _require_free(state, change.name)
    asset = state.insertable.get(change.asset)
    if asset is None:
        raise _StepError(f"the asset {change.asset!r} was not read; here are: {', '.join(state.insertable) or 'none'}")
    height = float(asset.size[2])
    if change.follow is None:
        path = recorded_path(placed_motion(change.waypoints, state.ego_to_world, height, change.yaw), height)
    else:
        path = _followed(state.find(change.follow, also_removed=True), change)
    _require_possible_speed(path, asset)
    category, seen = asset.category, asset.seen
    return EditedActor(
        change.name, change.asset, 1.0, asset.object_class, category, asset.size, True, path, None, change.phase, seen
    )


def _followed(actor: EditedActor, change: Insert) -> ActorPath:
    """The path of an object that follows an actor."""
    path = actor.path
    delay = 0.0 if change.start is None else change.start - path.begin
    beside = {"longitudinal": change.longitudinal, "lateral": change.lateral, "delay": delay}
    path = apply_duplicate(path, Duplicate.model_construct(track=change.name, name=change.name, phase=0.0, **beside))
    begin, end = actor.path.begin + delay, actor.path.end + delay
    path = replace(path, recorded=lambda times: actor.path.recorded(times - delay), begin=begin, end=end)
    if change.speed is not None:
        path = apply_speed(path, Speed(track=change.name, to=change.speed))
    if change.yaw:
        path = apply_shift(path, Shift(track=change.name, yaw=change.yaw))
    return path


def _require_possible_speed(path: ActorPath, asset: Insertable) -> None:
    times = np.arange(path.begin, min(path.end, path.begin + LOOKAHEAD) + SPEED_STEP, SPEED_STEP)
    places = path.poses(times, float(asset.size[2]))[:, :2, 3]
    fastest = float((np.linalg.norm(np.diff(places, axis=0), axis=1) / SPEED_STEP).max(initial=0.0))
    limit = MAX_SPEED.get(asset.object_class, MAX_SPEED_OF_VEHICLES)
    if fastest > limit:
        raise _StepError(
            f"it moves at up to {fastest:.1f} m/s, and the limit of the class {asset.object_class.value!r} is "
            f"{limit:g} m/s: give its points more time, or another 'speed'"
        )


def _require_free(state: _EditState, name: str) -> None:
    """Raises _StepError for the name of a copy that another object has."""
    taken = [*state.actors, *state.removed]
    if name in taken:
        used = ", ".join(short_ids(taken).values())
        raise _StepError(f"the name {name!r} in 'as' is already used; names in use: {used}")
    if name in state.other_ids:
        raise _StepError(f"the name {name!r} in 'as' is the id of another track; choose another name")


def _copied(state: _EditState, actor: EditedActor, copy: Duplicate | Place, path: ActorPath) -> _EditState:
    _require_free(state, copy.name)
    return state.with_actors(replace(actor, id=copy.name, path=path, edited=True, phase=actor.phase + copy.phase))


def color_matrix(change: Recolour) -> np.ndarray:
    """The matrix (3, 3) that maps RGB colours, as images encode them, to those after a step.

    A linear map applies to every spherical harmonic and to every coefficient of a colour that varies with time, so that
    shading and highlights stay. The hue is therefore a rotation about the axis of greys, which equals that of HSV for
    rotations by multiples of 120 degrees, and the saturation is the distance from that axis.

    With the colour of the paint, the matrix replaces the amount of paint in a colour, its chroma along that of the
    paint. Greys have none: white light mirrored by paint is added to it before and after.
    """
    if change.paint is not None:
        paint, new = np.array(change.paint), change.value * np.array(change.colour)
        chroma = paint - paint.mean()
        return np.eye(3) + np.outer(new - paint, chroma) / (chroma @ chroma)
    if change.colour is not None:
        return change.value * np.outer(change.colour, TO_GREY[0])
    turn = Rotation.from_rotvec(np.radians(change.hue) * GREY_AXIS).as_matrix()
    return change.value * (TO_GREY + change.saturation * turn @ (np.eye(3) - TO_GREY))
