"""Capacities of lists: exact, or planned from what the same lists needed before."""

import torch

from drivesplat.kernels import capacity
from drivesplat.kernels.capacity import MIN_CAPACITY, capacity_for


def capacities(*needed: int) -> list[int]:
    return [capacity_for(torch.tensor(entries)) for entries in needed]


def test_a_list_gets_an_exact_capacity_or_a_planned_one_with_a_margin():
    assert capacities(7) == [7]
    with capacity.exact() as needed:
        assert capacities(5000, 0) == [5000, 0]
    assert needed == [5000, 0]
    with capacity.planned(needed) as lists:
        assert capacities(9, 8) == [MIN_CAPACITY + 7500, MIN_CAPACITY]
    assert [(int(entries), available) for entries, available in lists] == [(9, MIN_CAPACITY + 7500), (8, MIN_CAPACITY)]
    assert capacities(3) == [3]
