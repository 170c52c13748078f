"""The ego vehicle: how it moves on the ground, and the controller that follows target poses."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from drivesplat.errors import RequestError
from drivesplat.settings.simulate import VehicleSettings
from drivesplat.simulate.driven_run import VehicleShape

STEP_S = 0.01
"""The longest step of the integration, seconds."""
PATH_STEP = 0.25
"""Metres between the places of a recorded path on which the ground is known."""
LOOK_AHEAD_S, MIN_LOOK_AHEAD = 0.8, 3.0
"""The controller steers to where the target will be in so many seconds, at least so many metres ahead."""
CATCH_UP_S = 0.5
"""The time constant in which the controller makes up for a lag, seconds."""


@dataclass(frozen=True)
class VehicleState:
    """The ego vehicle on the ground: its origin `x`, `y` (world metres), its heading `yaw` (radians, counterclockwise
    from x), its signed `speed` (m/s), the angle of its front wheels `steering` (radians, to the left), and its
    `acceleration` along its heading (m/s²)."""

    x: float
    y: float
    yaw: float
    speed: float
    steering: float = 0.0
    acceleration: float = 0.0

    def yaw_rate(self, wheelbase: float) -> float:
        """Radians per second."""
        return self.speed * math.tan(self.steering) / wheelbase

    def in_frame(self, points: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "k 2"]:
        """World points, x forward and y left of the vehicle."""
        shifted, turn = points - [self.x, self.y], [math.cos(self.yaw), math.sin(self.yaw)]
        return np.stack([shifted @ turn, shifted @ [-turn[1], turn[0]]], axis=1)


def shape_of(settings: VehicleSettings) -> VehicleShape:
    return VehicleShape(
        settings.length, settings.width, settings.height, settings.wheelbase, settings.rear_overhang
    )  # fmt: skip


def advanced(
    state: VehicleState, steering: float, acceleration: float, seconds: float, limits: VehicleSettings
) -> VehicleState:
    """The state after `seconds` of a kinematic bicycle whose reference point is the middle of the rear axle: x' = v cos
    yaw, y' = v sin yaw, yaw' = v tan(steering) / wheelbase, v' = acceleration.

    The wheels turn towards `steering` as fast as they can; both inputs and the speed are kept within the limits.
    """
    wanted = float(np.clip(steering, -limits.max_steering, limits.max_steering))
    pushed = float(np.clip(acceleration, -limits.max_braking, limits.max_acceleration))
    count = max(1, math.ceil(seconds / STEP_S - 1e-9))
    h, now = seconds / count, replace(state, acceleration=pushed)
    for _ in range(count):
        turn = limits.max_steering_rate * h
        angle = now.steering + min(max(wanted - now.steering, -turn), turn)
        speed = min(max(now.speed + pushed * h, -limits.max_reverse_speed), limits.max_speed) + 0.0  # no -0.0
        mean = 0.5 * (now.speed + speed)
        yaw = now.yaw + h * mean * math.tan(angle) / limits.wheelbase
        middle = 0.5 * (now.yaw + yaw)  # exact to second order in h
        now = VehicleState(
            now.x + h * mean * math.cos(middle), now.y + h * mean * math.sin(middle), yaw, speed, angle, pushed
        )  # fmt: skip
    return replace(now, acceleration=(now.speed - state.speed) / seconds)


def control_towards(
    state: VehicleState, targets: Float64[np.ndarray, "k 3"], step_s: float, limits: VehicleSettings
) -> tuple[float, float]:
    """The steering (radians) and the acceleration (m/s²) that follow target poses: x, y and yaw in the vehicle's frame
    after 1, 2, ... k steps of `step_s` seconds.

    Steering is pure pursuit (Coulter 1992): the arc through the target LOOK_AHEAD_S seconds ahead. The acceleration is
    that of a critically damped spring of the time constant CATCH_UP_S, to the targets' speed and to the first of them.
    """
    places = np.concatenate([np.zeros((1, 2)), targets[:, :2]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    ahead = max(MIN_LOOK_AHEAD, LOOK_AHEAD_S * abs(state.speed))
    if along[-1] < 1e-3:
        return state.steering, -state.speed / step_s
    forward = 1.0 if targets[-1, 0] >= 0.0 else -1.0
    aim = np.array([np.interp(ahead, along, places[:, axis]) for axis in (0, 1)])
    if along[-1] < ahead:  # beyond the last target: straight on
        heading = targets[-1, 2]
        aim = places[-1] + forward * (ahead - along[-1]) * np.array([math.cos(heading), math.sin(heading)])
    steering = math.atan2(2.0 * limits.wheelbase * aim[1], float(aim @ aim))
    speed = forward * (along[-1] - along[1]) / (step_s * (len(targets) - 1)) if len(targets) > 1 else state.speed
    lag = float(targets[0, 0]) - 0.5 * (state.speed + speed) * step_s
    return steering, 2.0 * (speed - state.speed) / CATCH_UP_S + lag / CATCH_UP_S**2


class RecordedGround:
    """The ground about the recorded path of the ego vehicle: planes through its poses (n, 4, 4)."""

    def __init__(self, ego_to_world: Float64[np.ndarray, "n 4 4"]):
        if not len(ego_to_world):
            raise RequestError("the drive has no path of the ego vehicle: there is no ground to drive on")
        places = ego_to_world[:, :2, 3]
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        kept = np.flatnonzero(np.diff(np.floor(np.concatenate([[0.0], np.cumsum(steps)]) / PATH_STEP), prepend=-1.0))
        self._poses = ego_to_world[kept]
        self._tree = cKDTree(self._poses[:, :2, 3])

    def ego_to_world(self, state: VehicleState) -> Float64[np.ndarray, "4 4"]:
        """The pose of the vehicle on the plane of the nearest recorded place."""
        near = self._poses[self._tree.query([state.x, state.y])[1]]
        up = near[:3, 2]
        height = near[2, 3] - (up[:2] @ (np.array([state.x, state.y]) - near[:2, 3])) / up[2]
        heading = np.array([math.cos(state.yaw), math.sin(state.yaw), 0.0])
        heading[2] = -(up[:2] @ heading[:2]) / up[2]
        forward = heading / np.linalg.norm(heading)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([forward, np.cross(up, forward), up], axis=1)
        pose[:3, 3] = state.x, state.y, height
        return pose


def state_of(ego_to_world: Float64[np.ndarray, "4 4"], speed: float, yaw_rate: float, wheelbase: float) -> VehicleState:
    """The state at a pose, whose wheels have the angle of this `yaw_rate` (radians per second)."""
    forward = ego_to_world[:2, 0]
    steering = math.atan(yaw_rate * wheelbase / speed) if abs(speed) > 0.5 else 0.0
    place = ego_to_world[:2, 3]
    return VehicleState(float(place[0]), float(place[1]), math.atan2(forward[1], forward[0]), speed, steering)
