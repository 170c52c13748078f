"""Policies: what drives the ego vehicle. A policy is any object with `act`, and `reset` if it keeps something."""

import math
from collections.abc import Mapping
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64

from drivesplat.errors import RequestError
from drivesplat.settings.simulate import SimulationSettings, TrafficSettings, VehicleSettings
from drivesplat.simulate.corridor import braking_for, first_in_the_way

CORRIDOR = 0.4
"""Metres beside the bodies within which something ahead is in the way."""
TURN_ACCELERATION = 2.5
"""The lateral acceleration in m/s² with which a policy takes bends."""


@runtime_checkable
class Policy(Protocol):
    """Drives. `act` gets an observation and facts (`Simulation.observation`, `Simulation.facts`), and gives an action
    of the settings' kind. `reset`, of a policy that has one, gets the seed of each run. Where `follows_recording` is
    True, the ego vehicle drives as recorded, whatever `act` gives."""

    def act(self, observation: Mapping[str, Any], facts: Mapping[str, Any]) -> Any:
        """The action of the next step."""


class RecordedEgo:
    """Drives as recorded."""

    follows_recording = True

    def act(self, observation: Mapping[str, Any], facts: Mapping[str, Any]) -> list[float]:
        """Nothing: the vehicle follows the recording."""
        return [0.0, 0.0]


class ConstantSpeed:
    """Follows the recorded path at the speed with which it begins, or at `speed` (m/s), whatever is ahead."""

    def __init__(self, speed: float | None = None):
        self._wanted = self._speed = speed

    def reset(self, seed: int) -> None:
        """Begins a run."""
        self._speed = self._wanted

    def act(self, observation: Mapping[str, Any], facts: Mapping[str, Any]) -> list[float]:
        """Pure pursuit of the path."""
        now = float(observation["ego"][0])
        self._speed = now if self._speed is None else self._speed
        return [pursuit(observation["route"], now, _vehicle(facts).wheelbase), 2.0 * (self._speed - now)]


class PurePursuit:
    """Follows the recorded path by pure pursuit (Coulter 1992), keeps its distance to what is ahead by the intelligent
    driver model (Treiber et al. 2000) on boxes, and is slow in bends."""

    def __init__(self, speed: float = 10.0, lateral: float = 0.0, **driver: float):
        """`speed` (m/s) is what it drives where nothing is ahead; `lateral` are the metres to the left of the recorded
        path at which it drives; `driver` are settings of `TrafficSettings`, such as `time_gap`."""
        self._speed, self._lateral = speed, lateral
        self._driver = TrafficSettings.model_validate(driver)

    def act(self, observation: Mapping[str, Any], facts: Mapping[str, Any]) -> list[float]:
        """Steering and acceleration."""
        now, route, driver = float(observation["ego"][0]), observation["route"].copy(), self._driver
        route[:, 0] -= self._lateral * np.sin(route[:, 2])
        route[:, 1] += self._lateral * np.cos(route[:, 2])
        wanted = max(min(self._speed, bend_speed(route)), 0.1)
        body = _vehicle(facts)
        gap, other = _ahead(route, observation["boxes"], body)
        push = driver.acceleration * (1.0 - (now / wanted) ** 4)
        push -= braking_for(gap, now, now - other, driver.time_gap, driver.acceleration, driver)
        return [pursuit(route, now, body.wheelbase), max(push, -8.0)]


def _ahead(
    route: Float32[np.ndarray, "r 3"], boxes: Float32[np.ndarray, "k 8"], body: VehicleSettings
) -> tuple[float, float]:
    """The metres to what is in the way, and its speed (m/s) along the path; infinite and 0 where nothing is."""
    there = boxes[boxes[:, 3] > 0.0].astype(np.float64)
    there = there[there[:, 2] - 0.5 * there[:, 5] < 2.0]  # not a bridge
    path = np.concatenate([np.zeros((1, 2)), route[:, :2]]).astype(np.float64)
    headings = np.stack([np.cos(there[:, 6]), np.sin(there[:, 6])], axis=1)
    width = body.width + 2.0 * CORRIDOR
    found = first_in_the_way(_evenly(path, 0.5), there[:, :2], headings, there[:, 3:5], width)
    if found is None:
        return math.inf, 0.0
    return found.near - (body.length - body.rear_overhang), float(there[found.index, 7]) * found.cosine


def _vehicle(facts: Mapping[str, Any]) -> VehicleSettings:
    """The vehicle that a policy drives."""
    return VehicleSettings.model_validate(facts.get("vehicle", {}))


def _evenly(path: Float64[np.ndarray, "p 2"], step: float) -> Float64[np.ndarray, "q 2"]:
    """Points of a path in equal steps of about so many metres."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    wanted = np.linspace(0.0, along[-1], max(2, int(along[-1] / step)))
    return np.stack([np.interp(wanted, along, path[:, axis]) for axis in (0, 1)], axis=1)


def pursuit(route: Float32[np.ndarray, "r 3"], speed: float, wheelbase: float) -> float:
    """The angle of the front wheels (radians) on the arc through the route's point that is 0.8 s ahead, at least 4 m;
    `speed` in m/s."""
    distance = np.hypot(route[:, 0], route[:, 1])
    far = distance >= max(4.0, 0.8 * speed)
    x, y, _ = route[int(far.argmax())] if far.any() else route[-1]
    return math.atan2(2.0 * wheelbase * float(y), max(float(x) ** 2 + float(y) ** 2, 1e-6))


def bend_speed(route: Float32[np.ndarray, "r 3"]) -> float:
    """The speed in m/s at which the bends of a route have TURN_ACCELERATION; it may brake with 2 m/s² before them."""
    steps = np.linalg.norm(np.diff(route[:, :2], axis=0, prepend=np.zeros((1, 2))), axis=1)
    turns = np.abs(np.angle(np.exp(1j * np.diff(route[:, 2].astype(np.float64), prepend=float(route[0, 2])))))
    curvature = turns / np.maximum(steps, 1e-3)
    allowed = TURN_ACCELERATION / np.maximum(curvature, 1e-4)
    return float(np.sqrt((allowed + 2.0 * 2.0 * np.cumsum(steps)).min()))


BUILT_IN = {"recorded": RecordedEgo, "constant_speed": ConstantSpeed, "pure_pursuit": PurePursuit}


def settings_for(settings: SimulationSettings, policy: Policy | None) -> SimulationSettings:
    """The settings of a run whose policy may follow the recording."""
    if getattr(policy, "follows_recording", False):
        return settings.model_copy(update={"recorded_until": 36000.0})
    return settings


def policy_of(name: str, settings: Mapping[str, Any]) -> Policy:
    """The policy with a name of BUILT_IN, or of an entry point `module:name`, called with the settings. Raises
    RequestError, one sentence, where there is none, or it is none.

    >>> policy_of("pure_pursuit", {"speed": 8.0})
    """
    try:
        if name in BUILT_IN:
            made = BUILT_IN[name](**settings)
        else:
            module, _, attribute = name.partition(":")
            if not attribute:
                raise RequestError(
                    f"there is no policy {name!r}; there are: {', '.join(BUILT_IN)}, and entry points as "
                    "my_package.my_module:MyPolicy"
                )
            made = getattr(import_module(module), attribute)(**settings)
    except RequestError:
        raise
    except Exception as error:  # of foreign code
        raise RequestError(f"policy {name!r} cannot be made: {type(error).__name__}: {error}") from None
    if not isinstance(made, Policy):
        raise RequestError(f"policy {name!r} has no method `act`")
    return made
