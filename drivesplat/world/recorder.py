"""Recordings of the street: images, LiDAR sweeps, visibility, and the poses and boxes of the tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from drivesplat.errors import ConfigError
from drivesplat.scene.images import project
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.tracks import matching_ids
from drivesplat.settings.edit import Edit
from drivesplat.settings.world import WorldDonor, WorldSettings
from drivesplat.world.optics.imaging import StreetImage, WorldCamera, geometry, render, to_bytes
from drivesplat.world.optics.lidar import ScanPattern, StreetScan, returns, scan, scan_pattern
from drivesplat.world.optics.lighting import Light, daylight, lamplight
from drivesplat.world.optics.raycast import RayCaster, StreetRays, StreetSnapshot
from drivesplat.world.optics.rig import SENSORS, RigSensor, image_height, key_frame_time, recording_sensors
from drivesplat.world.shapes.mesh import ColoredMesh
from drivesplat.world.street.edited import Variation, edited
from drivesplat.world.street.objects import EGO_BODY, EGO_VEHICLE, StreetObject
from drivesplat.world.street.street import Street, build_street
from drivesplat.world.tokens import instance_token

STREET_TO_GLOBAL = rigid(Rotation.from_euler("z", 0.62).as_matrix(), np.array([812.4, 1437.9, 0.0]))
"""Far from the origin, as in nuScenes."""
NIGHT_NOISE = 0.012
SURFACE_POINTS = 60
"""Number of points on the surface of a body, by which its visibility is counted."""


@dataclass(frozen=True)
class Viewpoint:
    """What is recorded or true: the drive as it was (None) or after an `edit`, without the object of the name `without`
    if given, seen from `left` metres to the left of the ego vehicle."""

    edit: str | None = None
    without: str | None = None
    left: float = 0.0


RECORDED = Viewpoint()


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the surface of a body of rigid pieces: the piece of each (n,), and its place (n, 3) in the piece's
    frame."""

    pieces: np.ndarray
    places: np.ndarray

    @classmethod
    def of(cls, meshes: Sequence[ColoredMesh]) -> "SurfacePoints":
        """SURFACE_POINTS points on a body of these pieces, spread evenly by area."""
        triangles = [mesh.triangles for mesh in meshes]
        pieces = np.repeat(np.arange(len(triangles)), [len(own) for own in triangles])
        corners = np.concatenate(triangles).reshape(-1, 3)
        mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
        places, faces = trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=0)
        return cls(pieces[faces], np.asarray(places))


def _donated(name: str, donor: WorldDonor) -> StreetObject:
    """The object of another street that an asset is made of."""
    objects = [item for item in build_street(donor.world).objects if item.category]
    by_id = {instance_token(donor.scene, item.name): item for item in objects}
    matching = matching_ids(donor.track, by_id)
    if len(matching) != 1:
        count = f"{len(matching)} objects have" if matching else "no object has"
        raise ConfigError(f"asset {name!r}: {count} an id starting with {donor.track!r} in scene {donor.scene}")
    return by_id[matching[0]]


class Recorder:
    """Records the street of `world` as the drive `scene`. Each recording has its own random generator."""

    def __init__(
        self,
        world: WorldSettings,
        scene: str = "demo",
        edits: Mapping[str, Edit] | None = None,
        donors: Mapping[str, WorldDonor] | None = None,
        street: Street | None = None,
        street_to_global: np.ndarray = STREET_TO_GLOBAL,
    ):
        """`donors` are the objects that the edits insert, by the names of their assets. `street` is recorded in place
        of that of `world` if given; `street_to_global` (4, 4) is its pose. Raises ConfigError where a world lacks a
        donor."""
        self.world, self.scene, self.edits = world, scene, dict(edits or {})
        self.street_to_global = street_to_global
        self._inserted = {name: _donated(name, donor) for name, donor in (donors or {}).items()}
        self.street = build_street(world) if street is None else street
        self.objects = self.street.objects
        self._variations: dict[str | None, Variation] = {None: Variation(self.street)}
        self._casters: dict[str | None, RayCaster] = {}

    def variation(self, edit: str | None = None) -> Variation:
        """The street and the ego path of the drive, or of an edit of it."""
        if edit not in self._variations:
            delays = [sensor.delay_us for sensor in recording_sensors(self.world) if sensor.is_camera]
            film_start = min(delays, default=0) * 1e-6
            self._variations[edit] = edited(
                self.street, self.scene, self.edits[edit], edit, self.world.seconds, film_start, self._inserted
            )
        return self._variations[edit]

    def _caster(self, edit: str | None) -> RayCaster:
        if edit not in self._casters:
            self._casters[edit] = RayCaster(self.variation(edit).street.objects)
        return self._casters[edit]

    def instance(self, name: str) -> str:
        """The token of an object: the id of its track."""
        return instance_token(self.scene, name)

    def snapshot(self, seconds: np.ndarray, view: Viewpoint = RECORDED, for_lidar: bool = False) -> StreetSnapshot:
        """The street at the times `seconds` (m,), as cameras or the LiDAR see it. From beside the recorded path the ego
        vehicle is not there."""
        hidden = (view.without, None if for_lidar and not view.left else EGO_BODY, EGO_VEHICLE if view.left else None)
        without = {name for name in hidden if name}
        return self._caster(view.edit).at(np.atleast_1d(np.asarray(seconds, dtype=np.float64)), without)

    def ego_to_street(self, seconds: np.ndarray, view: Viewpoint = RECORDED) -> np.ndarray:
        """True ego poses (m, 4, 4) at `seconds` (m,), moved to the left as the viewpoint states."""
        poses = self.variation(view.edit).ego_poses(np.atleast_1d(np.asarray(seconds, dtype=np.float64)))
        return poses @ rigid(np.eye(3), np.array([0.0, view.left, 0.0]))

    def ego_pose(self, seconds: float) -> np.ndarray:
        """The true ego pose (4, 4) of the drive at one time."""
        return self.ego_to_street(np.array([seconds]))[0]

    def light(self, seconds: float, view: Viewpoint = RECORDED) -> Light:
        """Light sources at a time."""
        ego = self.variation(view.edit).ego_poses(np.array([seconds]))[0]
        light = lamplight(self.street.lamps, ego) if self.world.night else daylight(self._random("light"))
        return light._replace(wet=float(self.world.wet))

    def camera(self, sensor: RigSensor, seconds: float, view: Viewpoint = RECORDED) -> WorldCamera:
        """The camera of an image with this timestamp. With a rolling shutter, each row has its own time and pose."""
        width, height = self.world.width, image_height(self.world.width)
        rows = (np.arange(height) - height // 2) / max(height - 1, 1) * self.world.readout_s
        times = seconds + (rows if self.world.readout_s else np.zeros(1))
        poses = self.ego_to_street(times, view) @ sensor.sensor_to_ego
        gains = self.world.exposures.get(sensor.channel, (1.0, 1.0, 1.0))
        return WorldCamera(sensor.intrinsics(width), times, poses, width, height, gains)

    def picture(self, sensor: RigSensor, time_us: int, view: Viewpoint = RECORDED) -> StreetImage:
        """The image without sensor noise, with depth, objects and classes."""
        seconds = time_us * 1e-6
        camera = self.camera(sensor, seconds, view)
        snapshot = self.snapshot(camera.seconds, view)
        return render(snapshot, self.light(seconds, view), camera, self.world.samples_per_pixel)

    def geometry(self, sensor: RigSensor, time_us: int, view: Viewpoint = RECORDED) -> StreetImage:
        """Depth, objects and classes of an image."""
        camera = self.camera(sensor, time_us * 1e-6, view)
        return geometry(self.snapshot(camera.seconds, view), camera)

    def to_bytes(self, radiance: np.ndarray, sensor: RigSensor, time_us: int) -> np.ndarray:
        """The recorded image (h, w, 3) uint8 of a radiance, with the sensor's noise."""
        return to_bytes(radiance, NIGHT_NOISE if self.world.night else 0.0, self._random(sensor.channel, time_us))

    def image(self, sensor: RigSensor, time_us: int) -> np.ndarray:
        """The recorded image (h, w, 3) uint8."""
        return self.to_bytes(self.picture(sensor, time_us).radiance, sensor, time_us)

    @cached_property
    def pattern(self) -> ScanPattern:
        """The rays of a revolution of the LiDAR."""
        return scan_pattern(self.world.lidar, self.world.lidar_hz)

    def scan(self, sensor: RigSensor, time_us: int, view: Viewpoint = RECORDED) -> StreetScan:
        """The revolution that ends at a time, or happens at it if the LiDAR does not spin."""
        times, poses = self._firings(sensor, time_us, view)
        snapshot = self.snapshot(times, view, for_lidar=True)
        random = self._random(sensor.channel, time_us)
        return scan(snapshot, self.pattern, poses, times, self.world.lidar, float(self.world.wet), random)

    def sweep(self, sensor: RigSensor, time_us: int, view: Viewpoint = RECORDED) -> np.ndarray:
        """The returns (n, 5) of a revolution; see `lidar.returns`."""
        return self.returns(self.scan(sensor, time_us, view), sensor, time_us, view)

    def returns(self, found: StreetScan, sensor: RigSensor, time_us: int, view: Viewpoint = RECORDED) -> np.ndarray:
        """The recorded returns (n, 5) of a scan."""
        _, poses = self._firings(sensor, time_us, view)
        at_timestamp = self.ego_to_street(np.array([time_us * 1e-6]), view)[0] @ sensor.sensor_to_ego
        return returns(found, self.pattern, poses, at_timestamp)

    def _firings(self, sensor: RigSensor, time_us: int, view: Viewpoint) -> tuple[np.ndarray, np.ndarray]:
        """Time (m,) and pose, sensor to street (m, 4, 4), of each moment of a revolution."""
        times = time_us * 1e-6 + self.pattern.moments[0]
        return times, self.ego_to_street(times, view) @ sensor.sensor_to_ego

    @cached_property
    def _surfaces(self) -> dict[int, SurfacePoints]:
        """Points on the surfaces of the objects that may have boxes, by their numbers."""
        return {n: SurfacePoints.of(item.body.pieces) for n, item in enumerate(self.objects) if item.category}

    def visible_fractions(self, index: int) -> np.ndarray:
        """The visible fraction of each object (objects,) within the images of key frame `index`, of all six cameras
        whether they record or not: of points on its surface."""
        visible, inside, surfaces = np.zeros(len(self.objects)), np.zeros(len(self.objects)), self._surfaces
        for sensor in SENSORS:
            if sensor.is_camera and surfaces:
                time = np.array([(key_frame_time(self.world, index) + sensor.delay_us) * 1e-6])
                camera, snapshot = self.camera(sensor, float(time[0])), self.snapshot(time)
                poses = snapshot.piece_poses()
                present = {n: own for n, own in surfaces.items() if self.objects[n].name in poses}
                if not present:
                    continue
                moved = [self._points(poses[self.objects[n].name][0], own) for n, own in present.items()]
                points, owners = np.concatenate(moved), np.repeat(list(present), SURFACE_POINTS)
                pixels, depth = project(points, inverse(camera.pose), camera.intrinsics)
                limit = np.array([camera.width, camera.height]) - 0.5
                chosen = (depth > 0.1) & ((pixels > -0.5) & (pixels < limit)).all(axis=1)
                center = camera.pose[:3, 3]
                toward, owner = points[chosen] - center, owners[chosen]
                toward /= np.linalg.norm(toward, axis=1, keepdims=True)
                rays = StreetRays(time, center[None], toward, np.zeros(len(toward), np.int32))
                found = snapshot.cast(rays).object
                visible += np.bincount(owner[found == owner], minlength=len(visible))
                inside += np.bincount(owner, minlength=len(inside))
        return visible / np.maximum(inside, 1)

    @staticmethod
    def _points(poses: np.ndarray, surface: SurfacePoints) -> np.ndarray:
        """Points (n, 3) on a body whose pieces have these poses (pieces, 4, 4)."""
        poses = poses[surface.pieces]
        return np.einsum("nij,nj->ni", poses[:, :3, :3], surface.places) + poses[:, :3, 3]

    def ego_to_global(self, seconds: float) -> np.ndarray:
        """The ego pose (4, 4) in the tables. `world.pose_noise` gives it the errors of nuScenes: z = 0, and smooth
        errors of roll, pitch and position."""
        pose = self.street_to_global @ self.ego_pose(seconds)
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
        box_to_ego = inverse(self.ego_pose(seconds)) @ item.box_poses(np.array([seconds]))[0]
        return self.ego_to_global(seconds) @ box_to_ego

    def _random(self, *name: str | int) -> np.random.Generator:
        words = [n if isinstance(n, int) else sum(ord(c) * 31**i for i, c in enumerate(n)) for n in name]
        return np.random.default_rng([self.world.random_seed, *(w % 2**32 for w in words)])
