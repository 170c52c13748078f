"""How much room tiles' lists of Gaussians get: as much as they need, which the device has to be asked for, or, where
nothing may wait for it, as much as they needed before and a margin."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

from jaxtyping import Int
from torch import Tensor

MARGIN, LEAST = 1.5, 4096
"""Room beyond what was needed: a factor, and a number of entries."""


@dataclass
class _Rooms:
    """Lists made in a context: how many entries each has needed, or may have."""

    planned: list[int] | None = None
    needs: list[int] = field(default_factory=list)
    lists: list[tuple[Tensor, int]] = field(default_factory=list)


_rooms: ContextVar[_Rooms | None] = ContextVar("rooms", default=None)


@contextmanager
def counted() -> Iterator[list[int]]:
    """Lists made meanwhile have the room they need; how much that was, one after the other."""
    with _entered(_Rooms()) as rooms:
        yield rooms.needs


@contextmanager
def given(needs: Sequence[int]) -> Iterator[list[tuple[Int[Tensor, ""], int]]]:
    """Lists made meanwhile have room for what as many lists needed before, and for more; how many entries each needs,
    which the device knows, and its room."""
    with _entered(_Rooms([LEAST + int(MARGIN * need) for need in needs])) as rooms:
        yield rooms.lists


def room_for(needed: Int[Tensor, ""]) -> int:
    """The room of the next list, which needs so many entries."""
    rooms = _rooms.get()
    if rooms is not None and rooms.planned is not None:
        room = rooms.planned[len(rooms.lists)]
        rooms.lists.append((needed, room))
        return room
    need = int(needed)
    if rooms is not None:
        rooms.needs.append(need)
    return need


@contextmanager
def _entered(rooms: _Rooms) -> Iterator[_Rooms]:
    before = _rooms.set(rooms)
    try:
        yield rooms
    finally:
        _rooms.reset(before)
