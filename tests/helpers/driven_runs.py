"""Runs in the closed loop along paths in closed form."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import rigid
from drivesplat.simulate.driven_run import DrivenRun, OtherObject, VehicleShape

SHAPE = VehicleShape()
"""4.6 m long and 1.9 m wide: from 0.9 m behind to 3.7 m before the rear axle."""
CAR = np.array([4.0, 2.0, 1.5])


def times(duration: float, dt: float = 0.1) -> np.ndarray:
    """Seconds from 0 to a duration, both included."""
    return np.arange(round(duration / dt) + 1) * dt


def poses(x, y, yaw, z=0.0) -> np.ndarray:
    """Poses (n, 4, 4) on the ground, of arrays or numbers."""
    x, y, yaw, z = np.broadcast_arrays(np.asarray(x, dtype=float), y, yaw, z)
    cos, sin, none = np.cos(yaw), np.sin(yaw), np.zeros(len(x))
    rotation = np.stack([cos, -sin, none, sin, cos, none, none, none, none + 1.0], axis=-1).reshape(-1, 3, 3)
    return rigid(rotation, np.stack([x, y, z], axis=-1))


def car(seconds: np.ndarray, x, y, yaw=0.0, present=None, **changes) -> OtherObject:
    """A car of 4 by 2 by 1.5 m whose middle is at x, y, standing on the ground."""
    n = len(seconds)
    there = np.ones(n, dtype=bool) if present is None else present
    placed = poses(np.broadcast_to(np.asarray(x, dtype=float), n), y, yaw, 0.75)
    return replace(OtherObject("car", ObjectClass.CAR, CAR, there, placed), **changes)


def driven(
    seconds: np.ndarray,
    ego_to_world: np.ndarray,
    speed,
    others: Sequence[OtherObject] = (),
    recorded: np.ndarray | None = None,
    drivable: Callable | None = None,
    loop_from: int = 0,
) -> DrivenRun:
    """A run that was recorded at the same times; by default the recorded vehicle drove the same path."""
    speed = np.broadcast_to(np.asarray(speed, dtype=float), len(seconds)).copy()
    recorded = ego_to_world if recorded is None else recorded
    return DrivenRun(
        seconds,
        ego_to_world,
        speed,
        np.zeros(len(seconds)),
        SHAPE,
        list(others),
        seconds,
        recorded,
        drivable,
        loop_from,
    )


def straight(duration: float, speed: float, **changes) -> DrivenRun:
    """Along x from the origin at a constant speed (m/s), backwards where it is negative."""
    seconds = times(duration)
    return driven(seconds, poses(speed * seconds, 0.0, 0.0), speed, **changes)


def circle(duration: float, speed: float, radius: float, dt: float = 0.1) -> DrivenRun:
    """To the left around (0, radius), from the origin along x."""
    seconds = times(duration, dt)
    angle = speed * seconds / radius
    return driven(seconds, poses(radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle), speed)


def moved(run: DrivenRun, by: np.ndarray) -> DrivenRun:
    """The same run in a world that is moved by a rigid transform (4, 4) about the vertical."""
    drivable, back = run.drivable, np.linalg.inv(by)

    def there(places: np.ndarray) -> np.ndarray:
        whole = np.column_stack([places, np.zeros(len(places)), np.ones(len(places))])
        return drivable((whole @ back.T)[:, :2])

    others = [replace(other, object_to_world=by @ other.object_to_world) for other in run.others]
    return replace(
        run, ego_to_world=by @ run.ego_to_world, recorded=by @ run.recorded, others=others,
        drivable=None if drivable is None else there,
    )  # fmt: skip
