"""The recorded path of the ego vehicle as a route: places in equal steps, and where a vehicle is on it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

STEP = 0.1
"""Metres between the places of a route."""
REST = 0.2
"""Metres that a vehicle moves at least from one place of its path to the next: less is noise of a vehicle at rest."""
SEARCH = 10.0
"""Metres of the route, beside those that were driven, within which a vehicle is looked for after a step: a path may
come back to where it was."""
LONGEST = 5000.0
"""Metres by which a route is continued at most."""


class OnRoute(NamedTuple):
    """Where a vehicle is on a route: metres `along` it, and its `offset` from it."""

    along: float
    offset: float


@dataclass(frozen=True, eq=False)
class Route:
    """The `places` (p, 2) of a path in steps of STEP metres, in which it is continued straight on; and the seconds
    (k,) at which its recorded places were reached, with the metres `reached` (k,) there."""

    places: Float64[np.ndarray, "p 2"]
    seconds: Float64[np.ndarray, " k"]
    reached: Float64[np.ndarray, " k"]

    @classmethod
    def of(
        cls, ego_to_world: Float64[np.ndarray, "m 4 4"], seconds: Float64[np.ndarray, " m"], beyond: float
    ) -> "Route":
        """The route of recorded poses at increasing `seconds`, continued by `beyond` metres."""
        recorded, kept = ego_to_world[:, :2, 3], [0]
        for number, place in enumerate(recorded):
            if np.hypot(*(place - recorded[kept[-1]])) >= REST:
                kept.append(number)
        places, forward = recorded[kept], ego_to_world[kept[-1], :2, 0]
        if len(kept) > 1:
            forward = places[-1] - places[-2]
        end = places[-1] + (min(beyond, LONGEST) + STEP) * forward / np.linalg.norm(forward)
        path = np.concatenate([places, end[None]])
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        wanted = np.arange(0.0, along[-1], STEP)
        even = np.stack([np.interp(wanted, along, path[:, axis]) for axis in (0, 1)], axis=1)
        return cls(even, seconds[kept], along[:-1])

    def begin(self, place: Float64[np.ndarray, "2"], second: float) -> OnRoute:
        """Where a vehicle is that is near the place of the recorded one at a second."""
        return self.nearest(place, float(np.interp(second, self.seconds, self.reached)), 0.0)

    def nearest(self, place: Float64[np.ndarray, "2"], before: float, driven: float) -> OnRoute:
        """Where a vehicle is that was `before` metres along, and has `driven` so many since."""
        reach = int((SEARCH + driven) / STEP)
        low = max(0, min(int(before / STEP), len(self.places) - 1) - reach)
        window = self.places[low : low + 2 * reach + 1]
        index = low + int(np.hypot(*(window - place).T).argmin())
        direction = self._direction(np.array([index]))[0]
        ahead = float(np.clip((place - self.places[index]) @ direction, -0.5 * STEP, 0.5 * STEP))
        return OnRoute(STEP * index + ahead, float(np.hypot(*(place - self.places[index] - ahead * direction))))

    def at(self, along: Float64[np.ndarray, " r"]) -> tuple[Float64[np.ndarray, "r 2"], Float64[np.ndarray, " r"]]:
        """The places (metres) and headings (radians) at metres along the route."""
        every = STEP * np.arange(len(self.places))
        points = np.stack([np.interp(along, every, self.places[:, axis]) for axis in (0, 1)], axis=1)
        direction = self._direction(np.rint(along / STEP).astype(int).clip(0, len(self.places) - 1))
        return points, np.arctan2(direction[:, 1], direction[:, 0])

    def _direction(self, index: np.ndarray) -> Float64[np.ndarray, "k 2"]:
        """Unit vectors along the route at some of its places."""
        last = len(self.places) - 1
        found = self.places[np.minimum(index + 1, last)] - self.places[np.maximum(index - 1, 0)]
        return found / np.linalg.norm(found, axis=1, keepdims=True)
