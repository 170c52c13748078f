"""A tiny street in nuScenes format: small images, few key frames, exact geometry.

A textured ground, a wall along the road, a parked truck, a car driving ahead, a pedestrian; a front camera that fires
35 ms before the LiDAR, image sweeps between key frames, a LiDAR of a few beams. Everything is cast ray by ray in numpy
from the same boxes that stand in the annotations, so that a test can compute what it expects.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

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


@dataclass
class Thing:
    """An annotated box: class, size (length, width, height), position at t = 0, velocity (m/s), heading (radians)."""

    category: str
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    velocity: tuple[float, float] = (0.0, 0.0)
    heading: float = 0.0
    color: tuple[int, int, int] = (200, 200, 200)
    seen: range | None = None
    visibility: str = "4"

    def at(self, seconds: float) -> np.ndarray:
        return np.array(self.position) + seconds * np.array([*self.velocity, 0.0])


def default_things() -> list[Thing]:
    return [
        Thing("vehicle.car", (4.0, 2.0, 1.6), (8.5, 0.0, 0.8), velocity=(4.2, 0.0), color=(230, 230, 235)),
        Thing("vehicle.truck", (6.0, 2.4, 2.6), (16.0, -4.5, 1.3), color=(60, 90, 180)),
        Thing("human.pedestrian.adult", (0.8, 0.8, 1.8), (12.0, 4.0, 0.9), velocity=(1.2, 0.0), color=(210, 60, 60)),
        Thing("movable_object.trafficcone", (0.5, 0.5, 0.9), (11.0, 3.0, 0.45), color=(250, 120, 20)),
    ]


@dataclass
class World:
    """The recording: `speed` of the ego vehicle in m/s, images of `width` x `height` pixels, dimmed by `light`, so many
    of them and of LiDAR sweeps between two key frames. With `rings` LiDAR is denser, and returns say their beam."""

    scenes: tuple[str, ...] = ("0001",)
    key_frames: int = 10
    width: int = 96
    height: int = 54
    speed: float = 4.0
    sweeps_between: int = 1
    lidar_between: int = 0
    rings: bool = False
    light: float = 1.0
    version: str = "v1.0-mini"
    things: list[Thing] = field(default_factory=default_things)

    @property
    def intrinsics(self) -> np.ndarray:
        """OpenCV's convention: integer coordinates at pixel centres."""
        focal = 0.62 * self.width
        return np.array([[focal, 0.0, (self.width - 1) / 2], [0.0, focal, (self.height - 1) / 2], [0.0, 0.0, 1.0]])

    def ego_at(self, seconds: float) -> np.ndarray:
        """The ego vehicle's position in the world of the drive (origin at its start)."""
        return np.array([self.speed * seconds, 0.0, 0.0])


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
    tables["log"].append(
        {"token": "log", "logfile": "tiny", "vehicle": "n000", "date_captured": "", "location": "tiny"}
    )
    tables["map"].append(
        {"token": "map", "category": "semantic_prior", "filename": "maps/map.png", "log_tokens": ["log"]}
    )
    levels = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
    tables["visibility"] += [{"token": token, "level": level, "description": ""} for token, level in levels.items()]
    for category in dict.fromkeys(thing.category for thing in world.things):
        tables["category"].append({"token": f"category {category}", "name": category, "description": ""})
    tables["sensor"] += [
        {"token": "CAM_FRONT", "channel": "CAM_FRONT", "modality": "camera"},
        {"token": "LIDAR_TOP", "channel": "LIDAR_TOP", "modality": "lidar"},
    ]
    camera = Rotation.from_matrix(CAMERA_TO_EGO).as_quat()
    tables["calibrated_sensor"] += [
        _calibrated("CAM_FRONT", CAMERA_AT, camera, world.intrinsics.tolist()),
        _calibrated("LIDAR_TOP", LIDAR_AT, np.array([0.0, 0.0, 0.0, 1.0]), []),
    ]


def _calibrated(sensor: str, translation: np.ndarray, xyzw: np.ndarray, intrinsic: list) -> dict:
    return {
        "token": f"calibrated {sensor}",
        "sensor_token": sensor,
        "translation": translation.tolist(),
        "rotation": [xyzw[3], *xyzw[:3]],
        "camera_intrinsic": intrinsic,
    }


def _write_scene(root: Path, tables: dict[str, list[dict]], world: World, scene: str) -> None:
    samples = [f"{scene} sample {i}" for i in range(world.key_frames)]
    tables["scene"].append(
        {
            "token": f"scene {scene}", "log_token": "log", "nbr_samples": world.key_frames, "name": f"scene-{scene}",
            "first_sample_token": samples[0], "last_sample_token": samples[-1], "description": "tiny",
        }
    )  # fmt: skip
    for i in range(len(samples)):
        tables["sample"].append(
            {**_linked(samples, i), "timestamp": START_US + i * KEY_FRAME_US, "scene_token": f"scene {scene}"}
        )
    _write_sensor(root, tables, world, scene, "CAM_FRONT", CAMERA_DELAY_US, world.sweeps_between)
    _write_sensor(root, tables, world, scene, "LIDAR_TOP", 0, world.lidar_between)
    for number, thing in enumerate(world.things):
        _annotate(tables, world, scene, thing, number)


def _linked(tokens: list[str], i: int) -> dict:
    return {
        "token": tokens[i],
        "prev": tokens[i - 1] if i else "",
        "next": tokens[i + 1] if i + 1 < len(tokens) else "",
    }


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
            Image.fromarray(cast_image(world, seconds)).save(root / filename, quality=95)
        else:
            filename = f"{folder}/{scene}__{i:04}.pcd.bin"
            cast_lidar(world, seconds).tofile(root / filename)
        tables["ego_pose"].append(
            {
                "token": token,
                "timestamp": START_US + offset_us,
                "rotation": [1.0, 0.0, 0.0, 0.0],
                "translation": (ORIGIN + world.ego_at(seconds)).tolist(),
            }
        )
        tables["sample_data"].append(
            {
                **_linked(tokens, i), "sample_token": f"{scene} sample {index}", "ego_pose_token": token,
                "calibrated_sensor_token": f"calibrated {channel}", "timestamp": START_US + offset_us,
                "fileformat": filename.rsplit(".")[-1],
                "is_key_frame": key, "height": world.height if channel == "CAM_FRONT" else 0,
                "width": world.width if channel == "CAM_FRONT" else 0, "filename": filename,
            }
        )  # fmt: skip


def _annotate(tables: dict, world: World, scene: str, thing: Thing, number: int) -> None:
    shown = [i for i in range(world.key_frames) if thing.seen is None or i in thing.seen]
    if not shown:
        return
    instance, tokens = f"{scene} instance {number}", [f"{scene} annotation {number} {i}" for i in shown]
    tables["instance"].append(
        {
            "token": instance, "category_token": f"category {thing.category}", "nbr_annotations": len(shown),
            "first_annotation_token": tokens[0], "last_annotation_token": tokens[-1],
        }
    )  # fmt: skip
    length, width, height = thing.size
    for position, i in enumerate(shown):
        tables["sample_annotation"].append(
            {
                **_linked(tokens, position), "sample_token": f"{scene} sample {i}", "instance_token": instance,
                "visibility_token": thing.visibility, "attribute_tokens": [], "size": [width, length, height],
                "translation": (ORIGIN + thing.at(i * KEY_FRAME_US * 1e-6)).tolist(),
                "num_lidar_pts": 10, "num_radar_pts": 0,
                "rotation": [np.cos(thing.heading / 2), 0.0, 0.0, np.sin(thing.heading / 2)],
            }
        )  # fmt: skip


def cast_image(world: World, seconds: float) -> np.ndarray:
    """What the front camera sees at a time: (h, w, 3) uint8."""
    x, y = np.meshgrid(np.arange(world.width), np.arange(world.height))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(world.intrinsics).T @ CAMERA_TO_EGO.T
    distance, color = cast(world, world.ego_at(seconds) + CAMERA_AT, rays.reshape(-1, 3), seconds)
    color[~np.isfinite(distance)] = SKY
    return (world.light * color).reshape(world.height, world.width, 3).astype(np.uint8)


def cast_lidar(world: World, seconds: float) -> np.ndarray:
    """Returns (n, 5) float32 in the sensor's frame, as nuScenes stores them."""
    step, beams = (0.75, 32) if world.rings else (1.5, 24)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, step)), np.radians(np.linspace(-28, 10, beams)))
    numbers = np.repeat(np.arange(beams), azimuth.shape[1]) if world.rings else np.ones(azimuth.size)
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    rays = rays.reshape(-1, 3)
    distance, _ = cast(world, world.ego_at(seconds) + LIDAR_AT, rays, seconds)
    hit = distance < 70.0
    points = rays[hit] * distance[hit, None]
    ego_mask = np.array([[0.5, 0.3, -0.4], [-0.5, -0.2, -0.5]])
    points, rings = np.concatenate([ego_mask, points]), np.concatenate([[1.0, 1.0], numbers[hit]])
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
    half = np.array(thing.size) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-half - start) / direction, (half - start) / direction
    enter, leave = np.fmin(near, far).max(axis=1), np.fmax(near, far).min(axis=1)
    t = np.where((enter < leave) & (enter > 0), enter, np.inf)
    return t, start + np.where(np.isfinite(t), t, 0.0)[:, None] * direction


def _ground_color(at: np.ndarray) -> np.ndarray:
    checks = (np.floor(at[:, 0] / 1.5) + np.floor(at[:, 1] / 1.5)) % 2
    return np.array([95.0, 95.0, 98.0]) + 45.0 * checks[:, None]


def _wall_color(at: np.ndarray) -> np.ndarray:
    stripes = np.floor(at[:, 0] / 2.0) % 2
    return np.where(stripes[:, None] > 0, np.array([150.0, 110.0, 80.0]), np.array([110.0, 80.0, 60.0]))
