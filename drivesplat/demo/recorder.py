"""The recording car on the street: images, LiDAR sweeps, what can be seen of each thing, and the truth beside it."""

from functools import cached_property

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from drivesplat.demo.bodies import Body
from drivesplat.demo.imaging import Camera, central_hits, developed, photograph
from drivesplat.demo.lidar import revolution
from drivesplat.demo.lighting import Light, daylight, lamplight
from drivesplat.demo.raycast import Layer, Stage
from drivesplat.demo.rig import KEY_FRAME_US, SENSORS, Sensor, height_of
from drivesplat.demo.street import Street, Thing, build_street
from drivesplat.scene.images import project
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.settings.world import WorldSettings

STREET_TO_GLOBAL = rigid(Rotation.from_euler("z", 0.62).as_matrix(), np.array([812.4, 1437.9, 0.0]))
"""Far from zero, as in nuScenes."""
NIGHT_NOISE = 0.012
SURFACE_POINTS = 60


class Recorder:
    """Everything that a drive on the street of `world` records. Deterministic: each recording has its own generator."""

    def __init__(self, world: WorldSettings):
        self.world = world
        self.street: Street = build_street(world)
        standing = [thing for thing in self.street.things if not thing.moves]
        moving = [thing for thing in self.street.things if thing.moves]
        self.things: tuple[Thing, ...] = (*standing, *moving)
        self._standing = len(standing)

    @cached_property
    def _layer(self) -> Layer:
        return Layer(self.things[: self._standing], 0.0)

    def stage(self, seconds: float, without: str | None = None) -> Stage:
        """The street at a time, without the thing of that name where given (one that moves)."""
        return Stage([thing for thing in self.things if thing.name != without], seconds, self._layer)

    def ego_to_street(self, seconds: float) -> np.ndarray:
        """(4, 4)."""
        return self.street.ego.pose_at(seconds)

    def light(self, seconds: float) -> Light:
        """What shines at a time."""
        if self.world.night:
            return lamplight(self.street.lamps, self.ego_to_street(seconds))
        return daylight(self._random("light"))

    def camera(self, sensor: Sensor, seconds: float, left: float = 0.0) -> Camera:
        """The camera as it fires at a time, moved `left` metres to the own car's left."""
        sensor_to_ego = rigid(np.eye(3), np.array([0.0, left, 0.0])) @ sensor.sensor_to_ego
        width, pose = self.world.width, self.ego_to_street(seconds) @ sensor_to_ego
        gains = self.world.exposures.get(sensor.channel, (1.0, 1.0, 1.0))
        return Camera(sensor.intrinsics(width), pose, width, height_of(width), gains)

    def image(self, sensor: Sensor, time_us: int) -> np.ndarray:
        """What the camera records (h, w, 3) uint8."""
        seconds = time_us * 1e-6
        noise = NIGHT_NOISE if self.world.night else 0.0
        radiance = self._photograph(self.stage(seconds), seconds, self.camera(sensor, seconds))
        return developed(radiance, noise, self._random(sensor.channel, time_us))

    def _photograph(self, stage: Stage, seconds: float, camera: Camera) -> np.ndarray:
        return photograph(stage, self.light(seconds), camera, self.world.samples_per_pixel)

    def truth(self, sensor: Sensor, time_us: int, left: float) -> dict[str, np.ndarray]:
        """The truth for one image: the view from `left` metres to the left and the view without the leading car (with
        none of its shadow), (h, w, 3) uint8 without noise; depth (h, w) in metres; number of the thing (h, w)."""
        seconds = time_us * 1e-6
        camera, stage = self.camera(sensor, seconds), self.stage(seconds)
        depth, things = central_hits(stage, camera)
        lateral = self._photograph(stage, seconds, self.camera(sensor, seconds, left))
        truth = {"lateral": developed(lateral), "depth": depth, "things": things}
        if self.street.leading:
            without = self._photograph(self.stage(seconds, self.street.leading), seconds, camera)
            truth["without_leading"] = developed(without)
        return truth

    def sweep(self, sensor: Sensor, time_us: int) -> tuple[np.ndarray, np.ndarray]:
        """The returns (n, 5) of a revolution, and how many each thing got (things,)."""
        seconds = time_us * 1e-6
        sensor_to_street = self.ego_to_street(seconds) @ sensor.sensor_to_ego
        points, thing = revolution(self.stage(seconds), sensor_to_street, self._random(sensor.channel, time_us))
        return points, np.bincount(thing, minlength=len(self.things))

    def visible_fractions(self, index: int) -> np.ndarray:
        """The share of each thing (things,) that the cameras of a key frame see of what lies in their images."""
        seen, aimed = np.zeros(len(self.things)), np.zeros(len(self.things))
        for sensor in SENSORS:
            if sensor.is_camera:
                seconds = (index * KEY_FRAME_US + sensor.delay_us) * 1e-6
                self._look(self.camera(sensor, seconds), seconds, seen, aimed)
        return seen / np.maximum(aimed, 1)

    def _look(self, camera: Camera, seconds: float, seen: np.ndarray, aimed: np.ndarray) -> None:
        stage = self.stage(seconds)
        for number, thing in enumerate(self.things):
            if thing.category is None:
                continue
            points = apply(stage.poses[number], _surface_points(thing.body_at(seconds)))
            pixels, depth = project(points, inverse(camera.camera_to_street), camera.intrinsics)
            inside = (
                (depth > 0.1)
                & (pixels > -0.5).all(axis=1)
                & (pixels < [camera.width - 0.5, camera.height - 0.5]).all(axis=1)
            )
            rays = points[inside] - camera.center
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            hits = stage.meet(camera.center, rays)
            seen[number] += (hits.thing == number).sum()
            aimed[number] += inside.sum()

    def ego_to_global(self, seconds: float) -> np.ndarray:
        """The ego pose (4, 4) that the tables state."""
        pose = STREET_TO_GLOBAL @ self.ego_to_street(seconds)
        return self._as_shipped(pose, seconds) if self.world.pose_noise else pose

    def _as_shipped(self, pose: np.ndarray, seconds: float) -> np.ndarray:
        """`pose` with errors of nuScenes' kind: smooth in time, flat."""
        phases = self._random("poses").uniform(0, 2 * np.pi, (4, 2))
        waves = np.sin(2 * np.pi * seconds / np.array([7.0, 2.9]) + phases) @ [0.8, 0.5]
        roll, pitch = 0.55 * waves[:2]
        result = pose.copy()
        result[:3, :3] = pose[:3, :3] @ Rotation.from_euler("xy", [roll, pitch], degrees=True).as_matrix()
        result[:2, 3] += 0.035 * waves[2:]
        result[2, 3] = 0.0
        return result

    def box_to_global(self, thing: Thing, seconds: float) -> np.ndarray:
        """The pose (4, 4) of the centre of a thing's box that the tables state: boxes are annotated as seen from the
        own car, and are as far off as its pose."""
        center = rigid(np.eye(3), np.array([0.0, 0.0, thing.body.size[2] / 2]))
        box_to_ego = inverse(self.ego_to_street(seconds)) @ thing.motion.pose_at(seconds) @ center
        return self.ego_to_global(seconds) @ box_to_ego

    def _random(self, *name: str | int) -> np.random.Generator:
        words = [n if isinstance(n, int) else sum(ord(c) * 31**i for i, c in enumerate(n)) for n in name]
        return np.random.default_rng([self.world.random_seed, *(w % 2**32 for w in words)])


def _surface_points(body: Body) -> np.ndarray:
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    return trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=0)[0]
