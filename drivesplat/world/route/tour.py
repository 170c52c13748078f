"""The route of the ego vehicle: loops through the grid, each of which passes its first street again."""

from collections.abc import Iterator
from itertools import islice

import numpy as np

from drivesplat.settings.world import WorldRouteSettings
from drivesplat.world.route.path import LanePath

APPROACH = 4
"""Number of streets straight ahead before the drive begins, for traffic that comes from there."""
BEGIN, EGO_SWAY = 16.0, 0.12
"""Metres behind a crossing at which the drive begins, and metres by which the ego vehicle sways in its lane."""


def ego_path(route: WorldRouteSettings, random_seed: int, seconds: float) -> LanePath:
    """The path of the ego vehicle in the grid frame, known for so many `seconds` at least. A longer one begins as a
    shorter one."""
    streets = APPROACH + int(seconds * route.speed / route.block_m) + 3
    headings = tuple(islice(tour(route, random_seed), streets))
    path = LanePath((-APPROACH, 0), headings, route.block_m, route.speed, sway=EGO_SWAY, suspension=True)
    return path.meeting(path.along_at(APPROACH, BEGIN), 0.0)


def tour(route: WorldRouteSettings, random_seed: int) -> Iterator[int]:
    """The headings of the streets, without end: first APPROACH streets to the east, then loops. After a loop the route
    passes its first street again, and goes on straight for one or two streets to where the next loop begins."""
    random, heading = np.random.default_rng([random_seed, 1]), 0
    yield from [heading] * APPROACH
    while True:
        loop = loop_headings(route, heading, random)
        yield from loop
        if route.closure == "opposite":
            heading = (heading + 2) % 4
        yield from [heading] * int(random.integers(2, 4))


def loop_headings(route: WorldRouteSettings, heading: int, random: np.random.Generator) -> list[int]:
    """The headings of the streets of a loop, of which the first is the one that is driven again.

    A loop is a rectangle of `route.loop_blocks` blocks, from which one or two corners are cut out so that it has turns
    to both sides. With the closure "opposite" the first street leads to the rectangle, and the loop ends before it.
    """
    half, side = route.loop_blocks // 2, int(random.choice([-1, 1]))
    width = int(random.integers(2, half - 1)) if half >= 4 else 1
    sides = [width, half - width] * 2
    turns = [side] * 4
    if route.closure == "opposite":
        heading, first = heading - side, [heading]
        sides.reverse()
    else:
        first = []
    if half >= 4:
        cut = int(random.integers(1, sides[2]))  # of the third side
        if sides[2] - cut >= 2 and random.random() < 0.5:
            _cut_corner(sides, turns, 2, int(random.integers(1, sides[2] - cut)), int(random.integers(1, sides[3])))
        _cut_corner(sides, turns, 1, int(random.integers(1, sides[1])), cut)
    found = list(first)
    for length, turn in zip(sides, turns, strict=True):
        found += [heading % 4] * length
        heading += turn
    return found


def _cut_corner(sides: list[int], turns: list[int], index: int, before: int, after: int) -> None:
    """Cuts out the corner behind side `index`: `before` blocks of this side, `after` blocks of the next."""
    turn = turns[index]
    sides[index : index + 2] = [sides[index] - before, after, before, sides[index + 1] - after]
    turns[index : index + 1] = [turn, -turn, turn]
