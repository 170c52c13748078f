"""Drives of a tiny street: small images, few key frames, exact geometry, in the format of nuScenes or as a scene.

A textured ground, a wall along the road, boxes that stand or move; a front camera that fires 35 ms before the LiDAR,
image sweeps between key frames, a LiDAR of a few beams. Everything is cast ray by ray in numpy from the same boxes that
stand in the annotations, so that a test can compute what it expects. `World` has the options; `waymo_drive` and the
tests of converters record the same world in other formats.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.extract import extract_scene
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.extract import SceneSource

ORIGIN = np.array([400.0, 1100.0, 0.0])
"""Where the drive begins in the dataset's global frame: far from zero, as in nuScenes."""
START_US = 1_532_402_927_647_951
KEY_FRAME_US = 500_000
CAMERA_DELAY_US = -35_000
CAMERA_TO_EGO = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The rotation of an OpenCV camera that looks forward."""
CAMERA_AT = np.array([1.7, 0.0, 1.5])
LIDAR_AT = np.array([0.9, 0.0, 1.8])
SKY = np.array([150, 190, 240])
CAMERA = rigid(CAMERA_TO_EGO, CAMERA_AT)
"""Camera to ego (4, 4)."""
TILTED_CAMERA = CAMERA @ rigid(Rotation.from_euler("xyz", [0.02, -0.03, 0.01]).as_matrix(), np.zeros(3))
TIMES = START_US + 100_000 * np.arange(6)
"""Key frames of drives that other formats record: 10 Hz."""
VERSION = "v1.0-mini"
REACH = 70.0
"""Of LiDARs, in metres."""
HELD_OUT = {"every_nth": 4, "offset": 2, "last_block": 2}
"""Of the tiny drive's 10 key frames: 2, 6; 8, 9."""
TRAINING = (0, 1, 3, 4, 5, 7)
"""The others."""
NOTHING_HELD_OUT = {"every_nth": 0, "last_block": 0}


@dataclass
class Thing:
    """An annotated box: class, size (length, width, height), position at t = 0, velocity (m/s), heading (radians), gain
    of velocity (m/s2); annotated at the key frames `seen` alone, where given."""

    category: str
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    velocity: tuple[float, float] = (0.0, 0.0)
    heading: float = 0.0
    color: tuple[int, int, int] = (200, 200, 200)
    seen: range | None = None
    visibility: str = "4"
    gain: tuple[float, float] = (0.0, 0.0)

    def at(self, seconds: float) -> np.ndarray:
        moved = seconds * np.array(self.velocity) + 0.5 * seconds**2 * np.array(self.gain)
        return np.array(self.position) + np.array([*moved, 0.0])


def default_things() -> list[Thing]:
    return [
        Thing("vehicle.car", (4.0, 2.0, 1.6), (8.5, 0.0, 0.8), velocity=(4.2, 0.0), color=(230, 230, 235)),
        Thing("vehicle.truck", (6.0, 2.4, 2.6), (16.0, -4.5, 1.3), color=(60, 90, 180)),
        Thing("human.pedestrian.adult", (0.8, 0.8, 1.8), (12.0, 4.0, 0.9), velocity=(1.2, 0.0), color=(210, 60, 60)),
        Thing("movable_object.trafficcone", (0.5, 0.5, 0.9), (11.0, 3.0, 0.45), color=(250, 120, 20)),
    ]


@dataclass
class World:
    """The recording: `speed` of the ego vehicle in m/s and its `turn` in rad/s, `left` metres to the left of its path;
    images of `width` x `height` pixels, dimmed by `light`, so many of them and of LiDAR sweeps between two key frames.
    With `rings` LiDAR is denser, and returns say their beam. `place` (4, 4): the street in the dataset's world, for
    formats that are written elsewhere."""

    scenes: tuple[str, ...] = ("0001",)
    key_frames: int = 10
    width: int = 96
    height: int = 54
    speed: float = 4.0
    turn: float = 0.0
    left: float = 0.0
    sweeps_between: int = 1
    lidar_between: int = 0
    rings: bool = False
    light: float = 1.0
    version: str = VERSION
    things: list[Thing] = field(default_factory=default_things)
    place: np.ndarray = field(default_factory=lambda: np.eye(4))

    @property
    def intrinsics(self) -> np.ndarray:
        """OpenCV's convention: integer coordinates at pixel centres."""
        focal = 0.62 * self.width
        return np.array([[focal, 0.0, (self.width - 1) / 2], [0.0, focal, (self.height - 1) / 2], [0.0, 0.0, 1.0]])

    def ego_pose(self, seconds: float) -> np.ndarray:
        """Ego vehicle to street (4, 4); the street's origin is the start of the path."""
        angle = self.turn * seconds
        way = np.array([np.sin(angle), 1.0 - np.cos(angle)]) / self.turn if self.turn else np.array([seconds, 0.0])
        turn = Rotation.from_euler("z", angle).as_matrix()
        return rigid(turn, np.array([*(self.speed * way), 0.0]) + self.left * turn[:, 1])

    def ego_at(self, seconds: float) -> np.ndarray:
        """The ego vehicle's position in the street."""
        return self.ego_pose(seconds)[:3, 3]

    def ego(self, time: float) -> np.ndarray:
        """Ego to the dataset's world (4, 4) at a timestamp."""
        return self.place @ self.ego_pose(seconds_of(time))

    def box(self, thing: Thing, time: float) -> np.ndarray:
        """Object to the dataset's world (4, 4) at a timestamp."""
        turn = Rotation.from_euler("z", thing.heading).as_matrix()
        return self.place @ rigid(turn, thing.at(seconds_of(time)))

    def image(self, seconds: float, camera: np.ndarray = CAMERA) -> np.ndarray:
        """What a camera sees that is mounted at `camera` (4, 4): (h, w, 3) uint8."""
        pose = self.ego_pose(seconds) @ camera
        x, y = np.meshgrid(np.arange(self.width), np.arange(self.height))
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(self.intrinsics).T @ pose[:3, :3].T
        distance, color = cast(self, pose[:3, 3], rays.reshape(-1, 3), seconds)
        color[~np.isfinite(distance)] = SKY
        return (self.light * color).reshape(self.height, self.width, 3).astype(np.uint8)

    def hits(self, scanner: np.ndarray, rays: np.ndarray, time: float) -> np.ndarray:
        """The first hits (k, 3) within reach of `rays` (n, 3) from a mount `scanner` (4, 4), in the dataset's world, at
        a timestamp."""
        pose = self.ego_pose(seconds_of(time)) @ scanner
        directions = rays @ pose[:3, :3].T
        distance, _ = cast(self, pose[:3, 3], directions, seconds_of(time))
        hit = distance < REACH
        points = pose[:3, 3] + directions[hit] * distance[hit, None]
        return points @ self.place[:3, :3].T + self.place[:3, 3]


SMALL = World(key_frames=3, width=48, height=27)


def turning_world(place: np.ndarray) -> World:
    """A vehicle that turns, past things with headings, in a world that is turned and tilted against the street."""
    car = Thing("car", (4.0, 2.0, 1.6), (10.0, 1.0, 0.8), velocity=(4.2, 0.5), heading=0.12, color=(230, 230, 235))
    truck = Thing("truck", (6.0, 2.4, 2.6), (16.0, -4.5, 1.3), heading=-0.4, color=(60, 90, 180))
    walker = Thing("pedestrian", (0.8, 0.6, 1.8), (9.0, 4.0, 0.9), (1.2, -0.3), heading=2.0, color=(210, 60, 60))
    return World(things=[car, truck, walker], turn=0.3, place=place)


def seconds_of(timestamp: float) -> float:
    """A timestamp as tiny worlds count: from the first key frame."""
    return (timestamp - START_US) * 1e-6


def source(**changes: Any) -> SceneSource:
    """Scene 0001 of a dataset in nuScenes' format by its front camera, with the images between key frames; `changes`
    replace that."""
    plain = {
        "dataset": "tiny", "reader": "nuscenes", "version": VERSION, "scene": "0001", "frames": None,
        "cameras": ("CAM_FRONT",), "sweeps": True, "on_missing": "stop",
    }  # fmt: skip
    return SceneSource(**{**plain, **changes})


@contextmanager
def uncompared(unless: bool = False) -> Iterator[None]:
    """Drives are read without comparing their recordings with each other, which takes most of the time and only warns;
    tests/readers/test_drive_warnings.py has that."""
    if unless:
        yield
        return
    module = "drivesplat.readers.drive_warnings"
    with patch(f"{module}.image_warnings", return_value=[]), patch(f"{module}.track_warnings", return_value=[]):
        yield


def scene_at(root: Path, sweeps: bool = True, **changes: Any) -> Scene:
    """The scene of that source below `root`, uncompared."""
    with uncompared():
        return extract_scene(source(sweeps=sweeps, **changes), root)


def drive(root: Path, *things: Thing, **world: Any) -> Scene:
    """A tiny drive past `things`, written to `root`."""
    return scene_at(write_world(root, World(things=list(things), **world)))


def rays_at(azimuth: float | np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """Unit rays (n, 3) of a column of beams, or of beams with azimuths (n,)."""
    level = np.cos(elevations)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevations)], axis=-1)


def seen_from(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """World points (n, 3) in the frame of `pose` (4, 4)."""
    to_frame = inverse(pose)
    return points @ to_frame[:3, :3].T + to_frame[:3, 3]


def depths_at(world: World, frame: Frame, rows: np.ndarray, columns: np.ndarray, subpixels: int = 1) -> np.ndarray:
    """The depth (..., n) in metres of what a frame sees in n = `subpixels`**2 places spread over each of the pixels at
    `rows` and `columns` (...); inf in the sky."""
    offsets = (np.arange(subpixels) + 0.5) / subpixels - 0.5
    dy, dx = (offset.ravel() for offset in np.meshgrid(offsets, offsets, indexing="ij"))
    x, y = columns[..., None] + dx, rows[..., None] + dy
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays = pixels @ np.linalg.inv(world.intrinsics).T @ CAMERA_TO_EGO.T
    seconds = seconds_of(frame.timestamp)
    depth, _ = cast(world, world.ego_at(seconds) + CAMERA_AT, rays, seconds)
    return depth.reshape(x.shape)


def true_depths(world: World, frame: Frame, subpixels: int = 1) -> np.ndarray:
    """The same for all pixels: (h, w, n)."""
    return depths_at(world, frame, *np.indices((world.height, world.width)), subpixels)


def shows(world: World, frame: Frame, thing: Thing, subpixels: int = 1) -> np.ndarray:
    """Which pixels (h, w) of a frame show a thing at their centre (odd `subpixels`: anywhere), others in the world
    before it or not."""
    alone = World(**{**vars(world), "things": [thing]})
    empty = World(**{**vars(world), "things": []})
    return (true_depths(alone, frame, subpixels) < true_depths(empty, frame, subpixels)).any(axis=2)


def cast_lidar(world: World, seconds: float) -> np.ndarray:
    """Returns (n, 5) float32 in the sensor's frame, as nuScenes stores them."""
    step, beams = (0.75, 32) if world.rings else (1.5, 24)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, step)), np.radians(np.linspace(-28, 10, beams)))
    numbers = np.repeat(np.arange(beams), azimuth.shape[1]) if world.rings else np.ones(azimuth.size)
    rays = rays_at(azimuth.ravel(), elevation.ravel())
    distance, _ = cast(world, world.ego_at(seconds) + LIDAR_AT, rays, seconds)
    hit = distance < REACH
    body = np.array([[0.5, 0.3, -0.4], [-0.5, -0.2, -0.5]])
    points, rings = np.concatenate([body, rays[hit] * distance[hit, None]]), np.concatenate([[1.0, 1.0], numbers[hit]])
    return np.column_stack([points, np.ones(len(points)), rings]).astype(np.float32)


def cast(world: World, origin: np.ndarray, rays: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance (n,) in units of each ray's length, and colour (n, 3), of what rays from a point hit first."""
    distance = np.full(len(rays), np.inf)
    color = np.zeros((len(rays), 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[:, 2] < 0, -origin[2] / rays[:, 2], np.inf)
        wall = np.where(rays[:, 1] > 0, (8.0 - origin[1]) / rays[:, 1], np.inf)
    for t, texture in ((ground, _ground_color), (wall, _wall_color)):
        at = origin + np.where(np.isfinite(t), t, 0.0)[:, None] * rays
        nearer = (t > 0) & (t < distance) & ((texture is _ground_color) | (at[:, 2] < 5.0))
        distance[nearer], color[nearer] = t[nearer], texture(at[nearer])
    for thing in world.things:
        t, at = _cast_box(thing, origin, rays, seconds)
        nearer = t < distance
        shade = 0.75 + 0.25 * np.sign(np.sin(5.0 * at[nearer].sum(axis=1)))
        distance[nearer], color[nearer] = t[nearer], np.array(thing.color) * shade[:, None]
    return distance, color


def _cast_box(thing: Thing, origin: np.ndarray, rays: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    rotation = Rotation.from_euler("z", thing.heading).as_matrix()
    start, direction = (origin - thing.at(seconds)) @ rotation, rays @ rotation
    t = to_box(np.array(thing.size) / 2, start, direction)
    return t, start + np.where(np.isfinite(t), t, 0.0)[:, None] * direction


def to_box(half: np.ndarray, start: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The distance (...), in units of each ray's length, to a box of half sizes `half` about the origin of the frame in
    which rays start and go on (..., 3); infinite where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-half - start) / direction, (half - start) / direction
    enter, leave = np.fmin(near, far).max(axis=-1), np.fmax(near, far).min(axis=-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def _ground_color(at: np.ndarray) -> np.ndarray:
    checks = (np.floor(at[:, 0] / 1.5) + np.floor(at[:, 1] / 1.5)) % 2
    return np.array([95.0, 95.0, 98.0]) + 45.0 * checks[:, None]


def _wall_color(at: np.ndarray) -> np.ndarray:
    stripes = np.floor(at[:, 0] / 2.0) % 2
    return np.where(stripes[:, None] > 0, np.array([150.0, 110.0, 80.0]), np.array([110.0, 80.0, 60.0]))


# Tables of nuScenes


def write_world(root: Path, world: World) -> Path:
    """Writes the dataset below `root`; returns `root`."""
    tables: dict[str, list[dict]] = {name: [] for name in _TABLES}
    _static_tables(tables, world)
    for scene in world.scenes:
        _write_scene(root, tables, world, scene)
    folder = root / world.version
    folder.mkdir(parents=True, exist_ok=True)
    (root / "maps").mkdir(exist_ok=True)
    Image.new("L", (4, 4)).save(root / "maps" / "map.png")
    for name, rows in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    return root


_TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip


def _static_tables(tables: dict[str, list[dict]], world: World) -> None:
    plain = {"token": "log", "logfile": "tiny", "vehicle": "n000", "date_captured": "", "location": "tiny"}
    tables["log"].append(plain)
    one_map = {"token": "map", "category": "semantic_prior", "filename": "maps/map.png", "log_tokens": ["log"]}
    tables["map"].append(one_map)
    levels = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
    tables["visibility"] += [{"token": token, "level": level, "description": ""} for token, level in levels.items()]
    for category in dict.fromkeys(thing.category for thing in world.things):
        tables["category"].append({"token": f"category {category}", "name": category, "description": ""})
    camera = Rotation.from_matrix(CAMERA_TO_EGO).as_quat(scalar_first=True).tolist()
    for sensor, modality, place, rotation, intrinsic in (
        ("CAM_FRONT", "camera", CAMERA_AT, camera, world.intrinsics.tolist()),
        ("LIDAR_TOP", "lidar", LIDAR_AT, [1.0, 0.0, 0.0, 0.0], []),
    ):
        tables["sensor"].append({"token": sensor, "channel": sensor, "modality": modality})
        at = {"translation": place.tolist(), "rotation": rotation, "camera_intrinsic": intrinsic}
        tables["calibrated_sensor"].append({"token": f"calibrated {sensor}", "sensor_token": sensor, **at})


def _write_scene(root: Path, tables: dict[str, list[dict]], world: World, scene: str) -> None:
    samples = [f"{scene} sample {i}" for i in range(world.key_frames)]
    tables["scene"].append({
        "token": f"scene {scene}", "log_token": "log", "nbr_samples": world.key_frames, "name": f"scene-{scene}",
        "first_sample_token": samples[0], "last_sample_token": samples[-1], "description": "tiny",
    })  # fmt: skip
    for i in range(len(samples)):
        at = {"timestamp": START_US + i * KEY_FRAME_US, "scene_token": f"scene {scene}"}
        tables["sample"].append({**_linked(samples, i), **at})
    _write_sensor(root, tables, world, scene, "CAM_FRONT", CAMERA_DELAY_US, world.sweeps_between)
    _write_sensor(root, tables, world, scene, "LIDAR_TOP", 0, world.lidar_between)
    for number, thing in enumerate(world.things):
        _annotate(tables, world, scene, thing, number)


def _linked(tokens: list[str], i: int) -> dict:
    return {"token": tokens[i], "prev": tokens[i - 1] if i else "", "next": [*tokens, ""][i + 1]}


def _write_sensor(root: Path, tables: dict, world: World, scene: str, channel: str, delay: int, between: int) -> None:
    steps = (world.key_frames - 1) * (between + 1) + 1
    tokens = [f"{scene} {channel} {i}" for i in range(steps)]
    for i, token in enumerate(tokens):
        index, fraction = divmod(i, between + 1)
        offset_us = index * KEY_FRAME_US + fraction * KEY_FRAME_US // (between + 1) + delay
        key, seconds = fraction == 0, offset_us * 1e-6
        folder = f"{'samples' if key else 'sweeps'}/{channel}"
        (root / folder).mkdir(parents=True, exist_ok=True)
        if channel == "CAM_FRONT":
            filename = f"{folder}/{scene}__{i:04}.jpg"
            Image.fromarray(world.image(seconds)).save(root / filename, quality=95)
        else:
            filename = f"{folder}/{scene}__{i:04}.pcd.bin"
            cast_lidar(world, seconds).tofile(root / filename)
        place, size = (ORIGIN + world.ego_at(seconds)).tolist(), (world.width, world.height)
        tables["ego_pose"].append({
            "token": token, "timestamp": START_US + offset_us, "rotation": [1.0, 0.0, 0.0, 0.0], "translation": place,
        })  # fmt: skip
        width, height = size if channel == "CAM_FRONT" else (0, 0)
        tables["sample_data"].append({
            **_linked(tokens, i), "sample_token": f"{scene} sample {index}", "ego_pose_token": token,
            "calibrated_sensor_token": f"calibrated {channel}", "timestamp": START_US + offset_us,
            "fileformat": filename.rsplit(".")[-1], "is_key_frame": key, "height": height, "width": width,
            "filename": filename,
        })  # fmt: skip


def _annotate(tables: dict, world: World, scene: str, thing: Thing, number: int) -> None:
    shown = [i for i in range(world.key_frames) if thing.seen is None or i in thing.seen]
    if not shown:
        return
    instance, tokens = f"{scene} instance {number}", [f"{scene} annotation {number} {i}" for i in shown]
    tables["instance"].append({
        "token": instance, "category_token": f"category {thing.category}", "nbr_annotations": len(shown),
        "first_annotation_token": tokens[0], "last_annotation_token": tokens[-1],
    })  # fmt: skip
    length, width, height = thing.size
    for position, i in enumerate(shown):
        tables["sample_annotation"].append({
            **_linked(tokens, position), "sample_token": f"{scene} sample {i}", "instance_token": instance,
            "visibility_token": thing.visibility, "attribute_tokens": [], "size": [width, length, height],
            "translation": (ORIGIN + thing.at(i * KEY_FRAME_US * 1e-6)).tolist(), "num_lidar_pts": 10,
            "num_radar_pts": 0, "rotation": [np.cos(thing.heading / 2), 0.0, 0.0, np.sin(thing.heading / 2)],
        })  # fmt: skip
