"""A trained drive in which a policy drives: its state from step to step, what it sees, and what it leaves."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from drivesplat.drive.cameras import PoseableCamera
from drivesplat.drive.drive_view import DriveScan, DriveView
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.drive.world_state import WorldState
from drivesplat.errors import RequestError
from drivesplat.model.road import RoadPart
from drivesplat.model.states import IMAGE, SCAN
from drivesplat.model.view import View
from drivesplat.scene.rigid import inverse
from drivesplat.settings.simulate import SimulationSettings
from drivesplat.simulate.drivable import drivable_strip
from drivesplat.simulate.driven_run import Drivable, DrivenRun, OtherObject
from drivesplat.simulate.footprints import ego_boxes, overlapping, upright_boxes
from drivesplat.simulate.traffic import MovingBox, Traffic
from drivesplat.simulate.vehicle import (
    RecordedGround,
    VehicleState,
    advanced,
    control_towards,
    shape_of,
    state_of,
)  # fmt: skip
from drivesplat.trajectories.reference_path import ReferencePath

BOX_COLUMNS = ("x", "y", "z", "length", "width", "height", "yaw", "speed")
"""What is known of an object: its place (metres) and heading (radians) in the frame of the ego vehicle at the centre of
its box, its size (metres), and its speed (m/s)."""
EGO_COLUMNS = ("speed", "acceleration", "steering", "yaw_rate", "seconds")
"""What is known of the ego vehicle: m/s, m/s², radians, radians per second, and seconds since the run began."""
PATH_S = 0.05
"""Seconds between the places of the recorded path."""
Observation = dict[str, Any]


class Simulation:
    """A drive, edited or not, in which the ego vehicle is driven. `reset` begins a run, `step` moves it on.

    >>> drive = drivesplat.open("results/demo/street")
    >>> run = Simulation(drive, SimulationSettings(cameras=()))
    >>> run.reset(seed=0)
    >>> run.step([0.0, -2.0])  # the wheels straight, braking with 2 m/s²
    """

    def __init__(self, drive: TrainedDrive, settings: SimulationSettings | None = None):
        """Raises RequestError for an unknown sensor, and a start that the drive does not have."""
        self.drive, self.settings = drive, settings or SimulationSettings()
        self.step_s = 1.0 / self.settings.rate_hz
        first, last = self._driven_span
        if not first <= self.settings.start < last:
            raise RequestError(
                f"{drive.where}: a run cannot begin at {self.settings.start:g} s; the vehicle drives from {first:.2f} "
                f"to {last:.2f} s"
            )
        names = self.drive.cameras[:1] if self.settings.cameras is None else self.settings.cameras
        self.cameras = {name: self._camera(name) for name in names}
        self.lidar = None if self.settings.lidar is None else drive.lidar(self.settings.lidar, self.settings.start)
        if not self.step_count:
            raise RequestError(f"{drive.where}: a run from {self.settings.start:g} s on has no step")
        self.trust: Callable[[], dict[str, float]] | None = None
        limits = self.settings.vehicle
        self._shape, self._vehicle = shape_of(limits), limits.model_dump()
        self._precompute()
        self.reset()

    @cached_property
    def _driven_span(self) -> tuple[float, float]:
        """The first and the last second at which the ego vehicle has a place in the drive."""
        times = np.append(np.arange(0.0, self.drive.duration, PATH_S), self.drive.duration)
        there = []
        for time in times:
            try:
                self.drive.ego_to_world(float(time))
            except RequestError:
                continue
            there.append(float(time))
        if not there:
            raise RequestError(f"{self.drive.where}: the ego vehicle has no place at any time")
        return there[0], there[-1]

    def _precompute(self) -> None:
        """Computes the states of the model at the times of all steps, which takes hardly longer than of one."""
        times = self.settings.start + self.step_s * np.arange(int(self.length_s * self.settings.rate_hz) + 2)
        within = np.unique(np.minimum(times, self.drive.duration)).tolist()
        wanted = ([IMAGE] if self.cameras else []) + ([SCAN] if self.lidar is not None else [])
        for want in wanted:
            self.drive.model.precompute(within, want)

    def _camera(self, name: str) -> PoseableCamera:
        camera = self.drive.camera(name, rolling_shutter=self.settings.rolling_shutter)
        return camera if self.settings.width is None else camera.resized(self.settings.width)

    @cached_property
    def _recorded(self) -> tuple[Float64[np.ndarray, " m"], Float64[np.ndarray, "m 4 4"]]:
        """Seconds of the recorded path, and the poses of the ego vehicle."""
        first, last = self._driven_span
        times = np.append(np.arange(first, last, PATH_S), last)
        return times, self.drive.ego_path(times)

    @cached_property
    def _ground(self) -> RecordedGround:
        return RecordedGround(self._recorded[1])

    @cached_property
    def drivable(self) -> Drivable | None:
        """The road beside the recorded path, as wide as the surface of the model's road is known there; None for a
        model without a road."""
        roads = [part.surface for part in self.drive.model.parts if isinstance(part, RoadPart)]
        return drivable_strip(self._route, next(iter(roads), None))

    # ---- from step to step

    def reset(self, seed: int | None = None) -> None:
        """Begins a run. `seed` draws what the settings vary; None: 0."""
        settings = self.settings
        actors = [*self.drive.edited_actors, *self.drive.static_objects.others]
        self.traffic = Traffic(
            actors, len(self.drive.edited_actors), settings.traffic, settings.start, self._driven_span[1],
            np.random.default_rng(0 if seed is None else seed),
        )  # fmt: skip
        self.steps, self.follows = 0, True
        self.ego = self._recorded_state(settings.start)
        self.progress, self._aside = self._route.follow(self._place, self._route.begin(settings.start), 0.0)
        self._log: list[tuple[VehicleState, np.ndarray, np.ndarray, np.ndarray]] = []
        self._note()

    @property
    def length_s(self) -> float:
        """The length of a run in seconds."""
        rest = self._driven_span[1] - self.settings.start
        wanted = self.settings.seconds
        if wanted is None:
            return rest
        return min(wanted, rest) if self.settings.beyond == "end" else wanted

    @property
    def seconds(self) -> float:
        """Seconds since the run began."""
        return self.steps * self.step_s

    @property
    def time(self) -> float:
        """The time of the drive, seconds since the first image."""
        return self.settings.start + self.seconds

    @property
    def ended(self) -> bool:
        """Whether the time of the run is over."""
        return self.steps >= self.step_count

    @property
    def step_count(self) -> int:
        """The number of steps of a run, the last of which is not beyond its length."""
        return int(self.length_s * self.settings.rate_hz + 1e-6)

    def step(self, action: Any) -> None:
        """Moves on by a step with an action of the settings' kind; values beyond the vehicle's limits are clipped.
        Raises RequestError after the end, and for an action that is not finite or has another shape, unless the vehicle
        still follows the recording."""
        if self.ended:
            raise RequestError("the run is over: reset() begins another one")
        self.follows = self.seconds + self.step_s <= self.settings.recorded_until + 1e-9
        driven = None if self.follows else self._control(action)
        self.traffic.advance(self.time, self.step_s, self.moving_box)
        self.steps += 1
        if driven is None:
            self.ego = self._recorded_state(self.time)
        else:
            self.ego = advanced(self.ego, *driven, self.step_s, self.settings.vehicle)
        driven_m = abs(self.ego.speed) * self.step_s
        self.progress, self._aside = self._route.follow(self._place, self.progress, driven_m)
        self._note()

    def _control(self, action: Any) -> tuple[float, float]:
        poses = self.settings.actions == "poses"
        shape = (self.settings.horizon, 3) if poses else (2,)
        try:
            values = np.array(action, dtype=np.float64)
        except Exception:  # of foreign types, such as tensors with gradients
            values = np.full(shape, np.nan)
        if values.shape != shape or not np.isfinite(values).all():
            what = "x, y and heading of each step" if poses else "steering and acceleration"
            raise RequestError(f"an action is {what}: finite numbers of shape {shape}, not {action!r}")
        if poses:
            return control_towards(self.ego, values, self.step_s, self.settings.vehicle)
        return float(values[0]), float(values[1])

    def _recorded_state(self, time: float) -> VehicleState:
        first, last = self._driven_span
        times = np.clip(time + np.array([0.0, -PATH_S, PATH_S]), first, last)
        now, before, after = self.drive.ego_path(times)
        behind, ahead = (inverse(now) @ pose for pose in (before, after))
        spans = np.maximum(times[[0, 2]] - times[[1, 0]], 0.0)
        speeds = [float(x / span) for x, span in zip((-behind[0, 3], ahead[0, 3]), spans, strict=True) if span > 0.0]
        turned = math.atan2(ahead[1, 0], ahead[0, 0]) - math.atan2(behind[1, 0], behind[0, 0])
        whole = float(spans.sum())
        state = state_of(now, sum(speeds) / len(speeds), turned / whole, self._shape.wheelbase)
        return replace(state, acceleration=(speeds[1] - speeds[0]) / (0.5 * whole) if len(speeds) > 1 else 0.0)

    def _note(self) -> None:
        """Keeps where everything is after a step."""
        self.ego_to_world = self._ego_pose()
        self._objects = self._seen_from_ego()
        self._touched = self._met()
        self._scanned: DriveScan | None = None
        self._log.append((self.ego, self.ego_to_world, self.traffic.poses, self.traffic.present))

    # ---- where everything is

    @property
    def _place(self) -> Float64[np.ndarray, "2"]:
        return np.array([self.ego.x, self.ego.y])

    def _ego_pose(self) -> Float64[np.ndarray, "4 4"]:
        """The pose of the ego vehicle, on the ground."""
        if self.follows:
            first, last = self._driven_span
            return self.drive.ego_path(np.array([min(max(self.time, first), last)]))[0]
        return self._ground.ego_to_world(self.ego)

    @property
    def moving_box(self) -> MovingBox:
        """The ego vehicle as others see it."""
        ego, shape = self.ego, self._shape
        centre = np.array([ego.x, ego.y]) + shape.centre * np.array([math.cos(ego.yaw), math.sin(ego.yaw)])
        return MovingBox(centre, ego.yaw, ego.speed, shape.length, shape.width)

    def ego_values(self) -> Float32[np.ndarray, " e"]:
        """The ego vehicle, by EGO_COLUMNS."""
        ego = self.ego
        rate = ego.yaw_rate(self._shape.wheelbase)
        return np.array([ego.speed, ego.acceleration, ego.steering, rate, self.seconds], dtype=np.float32)

    def route(self) -> Float32[np.ndarray, "r 3"]:
        """The recorded path ahead: x, y (metres) and heading (radians) in the frame of the ego vehicle at equal steps,
        from the place that is nearest to it. Beyond its end the path goes straight on."""
        wanted = self.progress + self.settings.route_step * np.arange(1, self.settings.route_points + 1)
        points, directions = self._route.at(wanted)
        turned = np.angle(np.exp(1j * (np.arctan2(directions[:, 1], directions[:, 0]) - self.ego.yaw)))
        return np.column_stack([self.ego.in_frame(points), turned]).astype(np.float32)

    @property
    def offset(self) -> float:
        """Metres from the recorded path."""
        return abs(self._aside)

    @property
    def outcome(self) -> str | None:
        """Why an episode ends here, though its time is not over, in words; None: it goes on."""
        if self.settings.end_on_collision and self._touched and not self.follows:
            return f"a contact with {self._touched[0]}"
        if self.settings.max_offset is not None and self.offset > self.settings.max_offset:
            return f"{self.offset:.1f} m from the recorded path"
        return None

    @cached_property
    def _route(self) -> ReferencePath:
        seconds, poses = self._recorded
        return ReferencePath(poses, seconds)

    def boxes(self) -> tuple[list[str], Float32[np.ndarray, "k 8"]]:
        """The ids of the objects that are there, the nearest first, and what is known of them, by BOX_COLUMNS."""
        ids, values = self._objects
        return ids[: self.settings.max_boxes], values[: self.settings.max_boxes].astype(np.float32)

    def _seen_from_ego(self) -> tuple[list[str], Float64[np.ndarray, "k 8"]]:
        traffic = self.traffic
        there = np.flatnonzero(traffic.present)
        local = inverse(self.ego_to_world) @ traffic.poses[there]
        order = np.argsort(np.linalg.norm(local[:, :2, 3], axis=1), kind="stable")
        local, there = local[order], there[order]
        yaw = np.arctan2(local[:, 1, 0], local[:, 0, 0])
        values = np.column_stack([local[:, :3, 3], traffic.sizes[there], yaw, traffic.speeds[there]])
        return [traffic.actors[i].id for i in there], values.reshape(-1, len(BOX_COLUMNS))

    def contacts(self) -> list[str]:
        """The ids of the objects that the body of the ego vehicle touches."""
        return list(self._touched)

    def _met(self) -> list[str]:
        traffic, ego = self.traffic, ego_boxes(self.ego_to_world[None], self._shape)
        touched = traffic.present & overlapping(ego, upright_boxes(traffic.poses, traffic.sizes))
        return [traffic.actors[i].id for i in np.flatnonzero(touched)]

    # ---- what is seen, and what is left

    def world(self) -> WorldState:
        """The drive as it now is, to be rendered from anywhere."""
        within = self.time <= self.drive.duration
        placements = None if self.traffic.as_recorded and within else self.traffic.placements()
        return self.drive.state(self._model_time, placements=placements)

    @property
    def _model_time(self) -> float:
        """The time at which the model is shown: beyond the recording its end."""
        return min(self.time, self.drive.duration)

    @property
    def place(self) -> dict[str, Any]:
        """Where `WorldState.render` and `scan` place the sensors: nothing while the vehicle follows the recording."""
        if self.follows:
            return {}
        rate = self.ego.yaw_rate(self._shape.wheelbase)
        velocity = np.array([self.ego.speed, 0.0, 0.0, 0.0, 0.0, rate])
        return {"ego_to_world": self.ego_to_world, "velocity": velocity}

    def observation(self) -> Observation:
        """What a policy sees now: `ego`, `route`, and `boxes` (max_boxes, 8), rows of zeros beyond the objects that are
        there; `cameras`, where there are some, by name and then by output: `rgb` (h, w, 3) uint8, `depth` (h, w) in
        metres, `instance` (h, w), an index into the objects of the model, -1 for anything else; `lidar`, where there is
        one: `range` in metres, 0 without a return, and `intensity` of every ray (b, a). Every array is a copy."""
        ids, boxes = self.boxes()
        padded = np.zeros((self.settings.max_boxes, len(BOX_COLUMNS)), dtype=np.float32)
        padded[: len(ids)] = boxes
        found: Observation = {"ego": self.ego_values(), "route": self.route(), "boxes": padded}
        if self.cameras:
            views = self.world().render(list(self.cameras.values()), outputs=self.settings.outputs, **self.place)
            found["cameras"] = {name: _arrays(view) for name, view in zip(self.cameras, views, strict=True)}
        if self.lidar is not None:
            scan = self.scan().arrays()
            values = {name: np.where(scan["returned"], scan[name], 0.0) for name in ("range", "intensity")}
            found["lidar"] = {name: own.astype(np.float32) for name, own in values.items()}
        return found

    def view(self, camera: PoseableCamera | None = None) -> View:
        """A camera, by default the first one, where it now is. Raises RequestError without cameras."""
        seen = next(iter(self.cameras.values()), None) if camera is None else camera
        if seen is None:
            raise RequestError("the simulation has no camera")
        return self.drive.view(seen, self._model_time, **self.place)

    def scan(self) -> DriveScan:
        """What the LiDAR measures now, without objects; once for a step. Raises RequestError without a LiDAR."""
        if self.lidar is None:
            raise RequestError("the simulation has no LiDAR")
        if self._scanned is None:
            self._scanned = self.world().scan(self.lidar, **self.place, with_instance=False)
        return self._scanned

    def facts(self) -> dict[str, Any]:
        """What is known beside the observation: the time of the drive, the pose of the ego vehicle, the ids of the
        objects in the rows of `boxes`, those that it touches, metres from the recorded path, whether it follows the
        recording, its settings, and what `trust` says, where it is set."""
        trusted = {} if self.trust is None else self.trust()
        return {
            **trusted,
            "time": self.time,
            "ego_to_world": self.ego_to_world.copy(),
            "objects": self.boxes()[0],
            "contacts": self.contacts(),
            "offset": self.offset,
            "follows_recording": self.follows,
            "vehicle": self._vehicle.copy(),
        }

    def driven(self) -> DrivenRun:
        """The record of the run so far. Every step counts where the vehicle has always followed the recording."""
        states, poses, objects, present = zip(*self._log, strict=True)
        every, there = np.stack(objects), np.stack(present)
        others = [
            OtherObject(actor.id, actor.object_class, actor.size, there[:, i], every[:, i])
            for i, actor in enumerate(self.traffic.actors)
            if there[:, i].any()
        ]
        seconds, recorded = self._recorded
        until = 0 if self.follows else int(self.settings.recorded_until * self.settings.rate_hz + 1e-6)
        return DrivenRun(
            self.settings.start + self.step_s * np.arange(len(states)),
            np.stack(poses),
            np.array([state.speed for state in states]),
            np.array([state.steering for state in states]),
            self._shape,
            others,
            seconds,
            recorded,
            self.drivable,
            until,
        )


def _arrays(view: DriveView) -> dict[str, np.ndarray]:
    """The outputs of a rendering as arrays; its colours as 8-bit integers."""
    found = {} if view.rgb is None else {"rgb": view.image}
    return {**found, **replace(view, rgb=None).arrays()}
