"""Who is seen in an edited drive: the recorded actors after every step of an edit."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from drivesplat.editing.path import Way, recorded_way
from drivesplat.editing.steps import copied, reversed_way, shifted, sped, stopped
from drivesplat.errors import ConfigError
from drivesplat.scene.motion import Motion
from drivesplat.scene.tracks import beginnings
from drivesplat.settings.edit import Duplicate, Edit, Rescale, Reverse, Shift, Speed, Step, Stop, Swap

STANDS = 0.5
"""Metres: what comes less far stands; its annotations tremble."""
LOOKS_AHEAD = 60.0
"""Seconds past the end of a track in which it may come on."""


@dataclass(frozen=True)
class Actor:
    """What is known of an object before any edit: `size` (3,) length, width, height in metres."""

    id: str
    category: str
    size: np.ndarray
    motion: Motion


@dataclass(frozen=True)
class Role:
    """Who is seen: `id`, a track's or the name of a duplicate, wearing the Gaussians of the track `source`, enlarged by
    `scale` about the box centre to `size` (3,) metres. Not `edited`: exactly as recorded."""

    id: str
    source: str
    scale: float
    category: str
    size: np.ndarray
    edited: bool
    way: Way = field(repr=False)

    def present(self, at: np.ndarray) -> np.ndarray:
        """Whether it is there at the seconds `at` (n,) of the film: (n,) bool."""
        return self.way.present(np.asarray(at, dtype=np.float64))

    def poses(self, at: np.ndarray) -> np.ndarray:
        """Object to world (n, 4, 4) at the seconds `at` (n,), at the centre of the enlarged box."""
        at = np.asarray(at, dtype=np.float64)
        return self.way.poses(at, float(self.size[2])) if self.edited else self.way.course.motion.poses(at)


def edited_cast(actors: Sequence[Actor], edit: Edit, where: str, others: Collection[str] = ()) -> list[Role]:
    """The roles after all steps of an edit: actors in their order without the removed ones, then duplicates.

    `others` are the ids of tracks that no step can name, and no duplicate may have. Raises ConfigError, one line that
    begins with `where` (the scene and the edit) and says what there is, where a step names what is not there, changes
    nothing or contradicts one before it.
    """
    cast = _Cast({actor.id: _as_recorded(actor) for actor in actors}, {}, frozenset(others))
    for number, step in enumerate(edit.steps, start=1):
        try:
            cast = _after(cast, step, number)
        except _ContradictionError as error:
            raise ConfigError(f"{where}, step {number} ({step.kind}): {error}") from None
    return list(cast.roles.values())


def _as_recorded(actor: Actor) -> Role:
    way = recorded_way(actor.motion, float(actor.size[2]))
    return Role(actor.id, actor.id, 1.0, actor.category, actor.size, False, way)


class _ContradictionError(Exception):
    """What is wrong with a step, without where."""


@dataclass(frozen=True)
class _Cast:
    """The roles so far by their ids; per id that was removed, the number of the step that did; ids of other tracks."""

    roles: dict[str, Role]
    removed: dict[str, int]
    others: frozenset[str]

    def find(self, name: str) -> Role:
        """The role of that id, or the only one whose id begins so."""
        known = [*self.roles, *self.removed]
        found = [name] if name in known else [other for other in known if other.startswith(name)]
        short = beginnings(known)
        if not found:
            there = ", ".join(short[other] for other in self.roles)
            raise _ContradictionError(
                f"no track that can be edited has an id that begins with {name!r}; there are: {there}"
            )
        if len(found) > 1:
            begun = ", ".join(short[other] for other in found)
            raise _ContradictionError(
                f"{len(found)} tracks have an id that begins with {name!r}: {begun}; give more of it"
            )
        if found[0] in self.removed:
            there = ", ".join(short[other] for other in self.roles) or "none"
            raise _ContradictionError(
                f"track {short[found[0]]} was removed by step {self.removed[found[0]]}; still there: {there}"
            )
        return self.roles[found[0]]

    def having(self, *roles: Role) -> "_Cast":
        """The cast with these roles changed, or added."""
        return replace(self, roles=self.roles | {role.id: role for role in roles})

    def without(self, role: Role, number: int) -> "_Cast":
        """The cast after step `number` has removed a role."""
        remaining = {name: other for name, other in self.roles.items() if name != role.id}
        return replace(self, roles=remaining, removed=self.removed | {role.id: number})


def _after(cast: _Cast, step: Step, number: int) -> _Cast:
    """The cast after a step."""
    change = step.change
    if step.kind == "ego":
        return cast
    role = cast.find(change.track)
    match change:
        case Swap():
            return _swapped(cast, role, change)
        case Duplicate():
            return _duplicated(cast, role, change)
        case Rescale():
            scaled = replace(role, scale=role.scale * change.factor, size=role.size * change.factor, edited=True)
            return cast.having(scaled)
        case Speed() | Stop() | Reverse() | Shift():
            return cast.having(replace(role, way=_driven(role, change), edited=True))
        case _:
            return cast.without(role, number)


def _driven(role: Role, change: Speed | Stop | Reverse | Shift) -> Way:
    match change:
        case Speed():
            _require_there(role, change.start, "start", before=True)
            if change.factor is not None:
                _require_pace(role, change.start)
            return sped(role.way, change)
        case Stop():
            _require_there(role, change.at, "at", before=False)
            return stopped(role.way, change)
        case Reverse():
            return reversed_way(role.way, change)
        case Shift():
            _require_there(role, change.start, "start", before=True)
            return shifted(role.way, change)


def _require_there(role: Role, second: float | None, key: str, before: bool) -> None:
    """What begins when the track is gone changes nothing; what begins `before` it is there may."""
    way = role.way
    if second is None or bool(way.present(np.array([second]))[0]):
        return
    if second <= way.end and (before or second >= way.begin):
        return
    problem = "ends before" if second > way.end else "begins after"
    raise _ContradictionError(
        f"the track {problem} {key!r} ({second:g} s): it was recorded from {way.begin:.2f} to {way.end:.2f} s"
    )


def _require_pace(role: Role, start: float | None) -> None:
    """A factor of what stands changes nothing."""
    begin = max(role.way.begin, start or 0.0)
    first, last = role.way.metres(np.array([begin, max(begin, role.way.end) + LOOKS_AHEAD]))
    if abs(last - first) < STANDS:
        raise _ContradictionError(
            f"the track stands from {begin:.2f} s on, and a factor of no speed is none; 'to' lets it drive"
        )


def _swapped(cast: _Cast, role: Role, swap: Swap) -> _Cast:
    other = cast.find(swap.other)
    if other.id == role.id:
        raise _ContradictionError(f"{swap.track!r} and {swap.other!r} are the same track; name two")
    return cast.having(replace(role, way=other.way, edited=True), replace(other, way=role.way, edited=True))


def _duplicated(cast: _Cast, role: Role, duplicate: Duplicate) -> _Cast:
    taken = [*cast.roles, *cast.removed]
    if duplicate.name in taken:
        there = ", ".join(beginnings(taken).values())
        raise _ContradictionError(f"'as' is {duplicate.name!r}, which is taken; choose another name than {there}")
    if duplicate.name in cast.others:
        raise _ContradictionError(f"'as' is {duplicate.name!r}, which is the id of another track; choose another name")
    return cast.having(replace(role, id=duplicate.name, way=copied(role.way, duplicate), edited=True))
