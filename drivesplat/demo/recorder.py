"""Recordings of the street: images, LiDAR sweeps, visibility, ground truth, and the poses and boxes of the tables."""

from functools import cached_property

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from drivesplat.demo.imaging import DemoCamera, depth_and_objects, render, to_bytes
from drivesplat.demo.lidar import scan
from drivesplat.demo.lighting import Light, daylight, lamplight
from drivesplat.demo.raycast import EmbreeLayer, StreetSnapshot
from drivesplat.demo.rig import KEY_FRAME_US, SENSORS, DemoSensor, image_height
from drivesplat.demo.street import StreetObject, build_street
from drivesplat.scene.images import project
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.settings.world import WorldSettings

STREET_TO_GLOBAL = rigid(Rotation.from_euler("z", 0.62).as_matrix(), np.array([812.4, 1437.9, 0.0]))
"""Far from the origin, as in nuScenes."""
NIGHT_NOISE = 0.012
SURFACE_POINTS = 60


class Recorder:
    """Records the street of `world`. Deterministic: each recording has its own random generator."""

    def __init__(self, world: WorldSettings):
        self.world = world
        self.street = build_street(world)
        self.objects = tuple(sorted(self.street.objects, key=lambda item: item.moves))

    @cached_property
    def _static(self) -> EmbreeLayer:
        return EmbreeLayer([item for item in self.objects if not item.moves], 0.0)

    def snapshot(self, seconds: float, without: str | None = None) -> StreetSnapshot:
        """The street at a time, without the moving object of that name if given."""
        return StreetSnapshot([item for item in self.objects if item.name != without], seconds, self._static)

    def ego_to_street(self, seconds: float) -> np.ndarray:
        """True ego pose (4, 4)."""
        return self.street.ego.pose_at(seconds)

    def light(self, seconds: float) -> Light:
        """Light sources at a time."""
        if self.world.night:
            return lamplight(self.street.lamps, self.ego_to_street(seconds))
        return daylight(self._random("light"))

    def camera(self, sensor: DemoSensor, seconds: float, left: float = 0.0) -> DemoCamera:
        """The camera at a time, shifted by `left` metres to the left of the ego vehicle."""
        sensor_to_ego = rigid(np.eye(3), np.array([0.0, left, 0.0])) @ sensor.sensor_to_ego
        width, pose = self.world.width, self.ego_to_street(seconds) @ sensor_to_ego
        gains = self.world.exposures.get(sensor.channel, (1.0, 1.0, 1.0))
        return DemoCamera(sensor.intrinsics(width), pose, width, image_height(width), gains)

    def image(self, sensor: DemoSensor, time_us: int) -> np.ndarray:
        """The recorded image (h, w, 3) uint8."""
        seconds = time_us * 1e-6
        radiance = self._render(self.snapshot(seconds), seconds, self.camera(sensor, seconds))
        return to_bytes(radiance, NIGHT_NOISE if self.world.night else 0.0, self._random(sensor.channel, time_us))

    def _render(self, snapshot: StreetSnapshot, seconds: float, camera: DemoCamera) -> np.ndarray:
        return render(snapshot, self.light(seconds), camera, self.world.samples_per_pixel)

    def truth(self, sensor: DemoSensor, time_us: int, left: float) -> dict[str, np.ndarray]:
        """Ground truth of one image, without sensor noise: `lateral`, the view from `left` metres to the left, and
        `without_leading`, the view without the leading vehicle and its shadow, (h, w, 3) uint8; `depth` (h, w) in
        metres; `objects` (h, w), indices."""
        seconds = time_us * 1e-6
        camera, snapshot = self.camera(sensor, seconds), self.snapshot(seconds)
        depth, objects = depth_and_objects(snapshot, camera)
        lateral = self._render(snapshot, seconds, self.camera(sensor, seconds, left))
        truth = {"lateral": to_bytes(lateral), "depth": depth, "objects": objects}
        if self.street.leading:
            without = self.snapshot(seconds, self.street.leading)
            truth["without_leading"] = to_bytes(self._render(without, seconds, camera))
        return truth

    def sweep(self, sensor: DemoSensor, time_us: int) -> tuple[np.ndarray, np.ndarray]:
        """The returns (n, 5) of a revolution (`lidar.scan`) and their number by object (objects,)."""
        seconds = time_us * 1e-6
        sensor_to_street = self.ego_to_street(seconds) @ sensor.sensor_to_ego
        points, objects = scan(self.snapshot(seconds), sensor_to_street, self._random(sensor.channel, time_us))
        return points, np.bincount(objects, minlength=len(self.objects))

    def visible_fractions(self, index: int) -> np.ndarray:
        """The visible fraction of each object (objects,) within the images of key frame `index`."""
        visible, inside = np.zeros(len(self.objects)), np.zeros(len(self.objects))
        for sensor in SENSORS:
            if sensor.is_camera:
                seconds = (index * KEY_FRAME_US + sensor.delay_us) * 1e-6
                self._count_points(self.camera(sensor, seconds), seconds, visible, inside)
        return visible / np.maximum(inside, 1)

    def _count_points(self, camera: DemoCamera, seconds: float, visible: np.ndarray, inside: np.ndarray) -> None:
        """Adds the number of surface points of each object that lie inside the image, and of those that are visible."""
        snapshot = self.snapshot(seconds)
        for number, item in enumerate(self.objects):
            if item.category is None:
                continue
            mesh = item.mesh_at(seconds)
            mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
            samples = trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=0)[0]
            points = apply(snapshot.poses[number], samples)
            pixels, depth = project(points, inverse(camera.camera_to_street), camera.intrinsics)
            limit = np.array([camera.width, camera.height]) - 0.5
            rays = points[(depth > 0.1) & ((pixels > -0.5) & (pixels < limit)).all(axis=1)] - camera.center
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            visible[number] += (snapshot.cast(camera.center, rays).object == number).sum()
            inside[number] += len(rays)

    def ego_to_global(self, seconds: float) -> np.ndarray:
        """The ego pose (4, 4) in the tables. `world.pose_noise` gives it the errors of nuScenes: z = 0, and smooth
        errors of roll, pitch and position."""
        pose = STREET_TO_GLOBAL @ self.ego_to_street(seconds)
        if self.world.pose_noise:
            phases = self._random("poses").uniform(0, 2 * np.pi, (4, 2))
            waves = np.sin(2 * np.pi * seconds / np.array([7.0, 2.9]) + phases) @ [0.8, 0.5]
            roll, pitch = 0.55 * waves[:2]
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("xy", [roll, pitch], degrees=True).as_matrix()
            pose[:2, 3] += 0.035 * waves[2:]
            pose[2, 3] = 0.0
        return pose

    def box_to_global(self, item: StreetObject, seconds: float) -> np.ndarray:
        """The pose (4, 4) of an object's box centre in the tables. Annotations are relative to the ego vehicle, so a
        box has the error of the ego pose."""
        center = rigid(np.eye(3), np.array([0.0, 0.0, item.mesh.size[2] / 2]))
        box_to_ego = inverse(self.ego_to_street(seconds)) @ item.path.pose_at(seconds) @ center
        return self.ego_to_global(seconds) @ box_to_ego

    def _random(self, *name: str | int) -> np.random.Generator:
        words = [n if isinstance(n, int) else sum(ord(c) * 31**i for i, c in enumerate(n)) for n in name]
        return np.random.default_rng([self.world.random_seed, *(w % 2**32 for w in words)])
