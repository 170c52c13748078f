"""The other objects of a run: as recorded or edited, or drivers who brake for what is ahead of them.

Every object has a clock of its own, which runs along its recorded or edited motion. Replay is the clock of the run; who
brakes lets it run slower, and who waits stops it. So nobody leaves his path, and a hand-over makes no jump.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from drivesplat.model.states import ActorPlacement
from drivesplat.scene.rigid import rigid
from drivesplat.settings.simulate import TrafficSettings
from drivesplat.simulate.corridor import braking_for, first_in_the_way
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.motion import HALF_STEP

TABLE_STEP = 0.05
"""Seconds between the tabulated poses; between them motions are nearly straight."""
MOVING = 0.3
"""Speed in m/s below which a recorded vehicle waits, and does not follow a path."""
CORRIDOR = 0.3
"""Metres beside the bodies within which something ahead is in the way."""
LOOK_AHEAD = 60.0
"""Metres ahead on its path to which a driver looks."""
INTERACTION = 0.5
"""The deceleration in m/s², beyond that of the recorded motion, at which a driver takes over."""
HARD_BRAKING = 8.0
"""The largest deceleration of a driver, m/s²."""
LEAST = 0.2
"""The least part of a time gap and an acceleration that a draw leaves."""
WALK_GAP, WALK_S = 1.5, 3.0
"""People wait while the ego vehicle comes this near to them (metres) within so many seconds."""


@dataclass(frozen=True)
class MotionTables:
    """The motions of a objects at the tabulated times `first` + i TABLE_STEP, of a recording until `last`: `places` (a,
    t, 3) metres, unit quaternions `turns` (a, t, 4; x, y, z, w), the lengths of their paths `walked` and `path` (a, t),
    whether they are `present` (a, t), and their horizontal `speeds` (a, t). Those that stand at the last time and are
    there, stay there afterwards (`stays`)."""

    first: float
    last: float
    places: Float64[np.ndarray, "a t 3"]
    turns: Float64[np.ndarray, "a t 4"]
    walked: Float64[np.ndarray, "a t"]
    path: Float64[np.ndarray, "a t"]
    present: Bool[np.ndarray, "a t"]
    speeds: Float64[np.ndarray, "a t"]
    stays: Bool[np.ndarray, " a"]

    @classmethod
    def of(cls, actors: Sequence[EditedActor], first: float, last: float) -> "MotionTables":
        """The tables from the second `first` to at least `last`."""
        times = first + TABLE_STEP * np.arange(int(np.ceil((last - first) / TABLE_STEP)) + 2)
        shape = (len(actors), len(times))
        poses = np.stack([actor.poses(times) for actor in actors]) if actors else np.zeros((*shape, 4, 4))
        turns = np.zeros((*shape, 4))
        if actors:
            turns = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(*shape, 4)
            flips = np.sign(np.einsum("atq,atq->at", turns[:, 1:], turns[:, :-1]))
            turns[:, 1:] *= np.cumprod(np.where(flips < 0.0, -1.0, 1.0), axis=1)[..., None]
        places = poses[..., :3, 3]
        steps = np.linalg.norm(np.diff(places[..., :2], axis=1), axis=2)
        speeds = np.concatenate([steps, steps[:, -1:]], axis=1) / TABLE_STEP
        path = np.concatenate([np.zeros((shape[0], 1)), np.cumsum(steps, axis=1)], axis=1)
        walked = np.stack([actor.walked(times) for actor in actors]) if actors else np.zeros(shape)
        present = np.stack([actor.present(times) for actor in actors]) if actors else np.zeros(shape, dtype=bool)
        return cls(first, last, places, turns, walked, path, present, speeds, _stay(present, speeds, times <= last))

    def poses(self, clocks: Float64[np.ndarray, " a"]) -> Float64[np.ndarray, "a 4 4"]:
        """The poses of all objects, each at its own time."""
        turns = self._between(self.turns, clocks)
        turns /= np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-12)
        turns[~turns.any(axis=1), 3] = 1.0
        return rigid(Rotation.from_quat(turns).as_matrix(), self._between(self.places, clocks))

    def at(self, values: np.ndarray, clocks: Float64[np.ndarray, " a"]) -> np.ndarray:
        """Values (a, t) of all objects, each at its own time."""
        return self._between(values[..., None], clocks)[:, 0]

    def there(self, clocks: Float64[np.ndarray, " a"]) -> Bool[np.ndarray, " a"]:
        """Whether each is present at its own time."""
        position = (clocks - self.first) / TABLE_STEP
        nearest = np.rint(position).astype(int).clip(0, self.present.shape[1] - 1)
        inside = (position >= -0.5) & (position <= self.present.shape[1] - 0.5)
        return (self.present[np.arange(len(clocks)), nearest] & inside) | (self.stays & (clocks >= self.last))

    def _between(self, values: np.ndarray, clocks: Float64[np.ndarray, " a"]) -> np.ndarray:
        position = ((clocks - self.first) / TABLE_STEP).clip(0.0, values.shape[1] - 1.0)
        before = np.minimum(position.astype(int), values.shape[1] - 2)
        share, rows = (position - before)[:, None], np.arange(len(clocks))
        return (1.0 - share) * values[rows, before] + share * values[rows, before + 1]


def _stay(present: np.ndarray, speeds: np.ndarray, within: np.ndarray) -> Bool[np.ndarray, " a"]:
    """Which objects are there and stand at the last time that is `within` the recording."""
    end = int(np.flatnonzero(within)[-1]) if within.any() else 0
    return present[:, end] & (speeds[:, end] < MOVING)


class Traffic:
    """The other objects of a run: `actors`, the first `rendered` of which the model has Gaussians of their own."""

    def __init__(
        self,
        actors: Sequence[EditedActor],
        rendered: int,
        settings: TrafficSettings,
        first: float,
        last: float,
        random: np.random.Generator,
    ):
        self.actors, self._rendered, self._settings = list(actors), rendered, settings
        self.tables = MotionTables.of(actors, first, last)
        count = len(self.actors)
        self.clocks, self.rates = np.full(count, first), np.ones(count)
        self.reacting = np.zeros(count, dtype=bool)
        self.speeds = self.tables.at(self.tables.speeds, self.clocks)
        self.poses, self.present = self.tables.poses(self.clocks), self.tables.there(self.clocks)
        self.sizes = np.stack([actor.size for actor in actors]) if count else np.zeros((0, 3))
        self._vehicles = np.array([actor.object_class.is_vehicle for actor in actors], dtype=bool)
        self._people = np.array([actor.object_class.is_human for actor in actors], dtype=bool)
        drawn = 1.0 + settings.variation * random.standard_normal((2, count)).clip(-2.0, 2.0)
        spread = np.maximum(drawn, LEAST)
        self._time_gaps, self._accelerations = np.array([[settings.time_gap], [settings.acceleration]]) * spread

    @property
    def as_recorded(self) -> bool:
        """Whether all objects have been where they were recorded, or edited to be."""
        return not self.reacting.any()

    def placements(self) -> dict[str, ActorPlacement]:
        """The places of the rendered objects that are present, by id."""
        moved = [self.clocks + side * HALF_STEP * self.rates for side in (-1.0, 1.0)]
        around = [self.tables.poses(clocks) for clocks in moved]
        walked, *beside = (self.tables.at(self.tables.walked, clocks) for clocks in (self.clocks, *moved))
        found = {}
        for i, actor in enumerate(self.actors[: self._rendered]):
            if self.present[i]:
                found[actor.id] = ActorPlacement(
                    actor.source, self.poses[i], actor.scale, actor.color_matrix, (around[0][i], around[1][i]),
                    float(walked[i]), (float(beside[0][i]), float(beside[1][i])), actor.phase, actor.shade,
                )  # fmt: skip
        return found

    def advance(self, now: float, seconds: float, ego: "MovingBox") -> None:
        """Lets the objects move on from the second `now`, in sight of the ego vehicle."""
        rates = np.ones(len(self.actors))
        if self._settings.vehicles == "react":
            rates = self._driven(seconds, ego, rates)
        if self._settings.people == "stop":
            waiting = self._people & self.present & self._is_close(ego)
            self.reacting |= waiting
            rates[waiting] = 0.0
        exact = ~self.reacting  # without the rounding of sums
        self.clocks = np.where(exact, now + seconds, self.clocks + rates * seconds)
        self.rates = rates
        self.speeds = self.tables.at(self.tables.speeds, self.clocks) * rates
        self.poses, self.present = self.tables.poses(self.clocks), self.tables.there(self.clocks)

    def _is_close(self, ego: "MovingBox") -> Bool[np.ndarray, " a"]:
        """Whether the ego vehicle, if it goes on as it does, comes within WALK_GAP of each object within WALK_S."""
        ahead = np.linspace(0.0, WALK_S, 16)[:, None] * ego.velocity[None] + ego.centre
        turn = np.array([[np.cos(ego.yaw), np.sin(ego.yaw)], [-np.sin(ego.yaw), np.cos(ego.yaw)]])
        local = np.abs((self.poses[:, None, :2, 3] - ahead) @ turn.T) - 0.5 * np.array([ego.length, ego.width])
        distance = np.linalg.norm(local.clip(min=0.0), axis=2).min(axis=1)
        return (distance < WALK_GAP) & (np.linalg.norm(ego.velocity) > MOVING)

    def _driven(self, seconds: float, ego: "MovingBox", rates: Float64[np.ndarray, " a"]) -> Float64[np.ndarray, " a"]:
        """The rates of the clocks of drivers."""
        recorded = self.tables.at(self.tables.speeds, self.clocks)
        later = self.tables.at(self.tables.speeds, self.clocks + seconds)
        for i in np.flatnonzero(self._vehicles & self.present).tolist():
            if not self.reacting[i] and recorded[i] < MOVING:
                continue  # it stands, or waits as recorded
            gap, approach = self._gap(i, ego)
            own = (float(values[i]) for values in (self._time_gaps, self._accelerations))
            interaction = braking_for(gap, float(self.speeds[i]), approach, *own, self._settings)
            brakes = max(float(recorded[i] - later[i]) / seconds, 0.0)
            if not self.reacting[i] and interaction < INTERACTION + brakes:
                continue
            self.reacting[i] = True
            rates[i] = self._rate(i, interaction, float(recorded[i]), seconds)
        return rates

    def _rate(self, i: int, interaction: float, recorded: float, seconds: float) -> float:
        """The rate of a driver's clock by the intelligent driver model (Treiber et al. 2000): an acceleration of a (1 -
        (v / v0)^4 - (s* / s)^2), where the desired speed v0 is the recorded one at this place."""
        desired, speed = max(recorded, MOVING), self.speeds[i]
        if recorded < MOVING and interaction < self._accelerations[i]:
            return 1.0  # waits as recorded
        push = self._accelerations[i] * (1.0 - min(speed / desired, 4.0) ** 4) - interaction
        speed = max(speed + max(push, -HARD_BRAKING) * seconds, 0.0)
        return float(min(speed / desired, 3.0))

    def _gap(self, i: int, ego: "MovingBox") -> tuple[float, float]:
        """The metres of free path ahead of a driver, and how much faster (m/s) he is than what is there; infinite and 0
        where nothing is. While he drives as recorded, others who do so are not in his way."""
        others = np.flatnonzero(self.present & (self.reacting if not self.reacting[i] else True))
        others = others[others != i]
        centres = np.concatenate([self.poses[others, :2, 3], ego.centre[None]])
        near = np.linalg.norm(centres - self.poses[i, :2, 3], axis=1) < LOOK_AHEAD + 10.0
        if not near.any():
            return np.inf, 0.0
        table, start = self.tables, self.tables.at(self.tables.path, self.clocks)[i]
        ahead = (table.path[i] > start + 0.05) & (table.path[i] < start + LOOK_AHEAD) & table.present[i]
        headings = np.concatenate([self.poses[others, :2, 0], ego.forward[None]])
        sizes = np.concatenate([self.sizes[others, :2], [[ego.length, ego.width]]])
        path = np.concatenate([self.poses[i, :2, 3][None], table.places[i, ahead, :2]])
        width = self.sizes[i, 1] + 2.0 * CORRIDOR
        found = first_in_the_way(path, centres[near], headings[near], sizes[near], float(width))
        if found is None:
            return np.inf, 0.0
        speed = np.append(self.speeds[others], ego.speed)[near][found.index]
        return found.near - 0.5 * float(self.sizes[i, 0]), float(self.speeds[i] - found.cosine * speed)


@dataclass(frozen=True)
class MovingBox:
    """The ego vehicle as others see it: the middle of its body `centre` (2,), its heading `yaw` (radians), its signed
    `speed` (m/s), `length` and `width` (metres)."""

    centre: Float64[np.ndarray, "2"]
    yaw: float
    speed: float
    length: float
    width: float

    @property
    def forward(self) -> Float64[np.ndarray, "2"]:
        """The direction of its heading."""
        return np.array([np.cos(self.yaw), np.sin(self.yaw)])

    @property
    def velocity(self) -> Float64[np.ndarray, "2"]:
        """In m/s."""
        return self.speed * self.forward
