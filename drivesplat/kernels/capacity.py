"""Capacity of buffers whose size is known on the device only: tiles' lists of Gaussians, and the Gaussians that reach
the tiles of a LiDAR scan. The latter count as a list, too.

An exact capacity needs host synchronisation. Where that is not allowed, as in a CUDA graph, buffers get the number of
entries that the same lists needed before, plus a margin.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

import torch
from jaxtyping import Int
from torch import Tensor

MARGIN, MIN_CAPACITY = 1.5, 4096
"""A planned capacity is MIN_CAPACITY plus MARGIN times the entries needed before."""


@dataclass
class _Capacities:
    """For the lists made in a context: their planned capacities (None: exact ones), the numbers of entries that they
    needed, and the lists with a planned capacity."""

    planned: list[int] | None = None
    needed: list[int] = field(default_factory=list)
    lists: list[tuple[Tensor, int]] = field(default_factory=list)


_current: ContextVar[_Capacities | None] = ContextVar("capacities", default=None)


@contextmanager
def exact() -> Iterator[list[int]]:
    """Lists made in this context have exact capacities. Yields their numbers of entries, in the order of creation."""
    with _entered(_Capacities()) as capacities:
        yield capacities.needed


@contextmanager
def planned(needed: Sequence[int]) -> Iterator[list[tuple[Int[Tensor, ""], int]]]:
    """Lists made in this context have planned capacities, computed from the entries that the same lists needed before.
    Yields, for every list, the number of entries that it needs (on the device) and its capacity."""
    with _entered(_Capacities([MIN_CAPACITY + int(MARGIN * entries) for entries in needed])) as capacities:
        yield capacities.lists


def capacity_for(needed: Int[Tensor, ""]) -> int:
    """The capacity of the next list, which needs `needed` entries. Exact capacities synchronise with the host."""
    return capacities_for([needed])[0]


def capacities_for(needed: Sequence[Int[Tensor, ""]]) -> list[int]:
    """The capacities of the next lists. Exact ones synchronise with the host once."""
    capacities = _current.get()
    if capacities is not None and capacities.planned is not None:
        first = len(capacities.lists)
        chosen = capacities.planned[first : first + len(needed)]
        capacities.lists.extend(zip(needed, chosen, strict=True))
        return chosen
    entries: list[int] = torch.stack(list(needed)).tolist() if len(needed) > 1 else [int(n) for n in needed]
    if capacities is not None:
        capacities.needed.extend(entries)
    return entries


@contextmanager
def _entered(capacities: _Capacities) -> Iterator[_Capacities]:
    before = _current.set(capacities)
    try:
        yield capacities
    finally:
        _current.reset(before)
