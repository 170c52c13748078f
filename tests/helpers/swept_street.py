"""A drive folder without cameras: a LiDAR on a vehicle that drives between two walls, behind a car."""

import json
from pathlib import Path

import numpy as np

from helpers.drives import to_box

BEAMS = np.radians(np.linspace(-24.0, 6.0, 16))
STEPS = 180
KEY_FRAMES, KEY_FRAME_US, FIRST_US = 8, 500_000, 1_000_000
SPEED, CAR_SPEED = 2.0, 4.0
HEIGHT, WALL, FARTHEST = 1.8, 8.0, 40.0
CAR_SIZE, CAR_AT = (4.0, 2.0, 1.6), (10.0, 2.0, 0.8)
GROUND, WALLS, CAR = 0.2, 0.6, 0.9
"""Intensities."""


def swept(ego: float, car: float) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (b, a) in metres from the LiDAR over (ego, 0, 0), inf without a return, and intensities, with the car's
    centre at `car` along the street."""
    up, around = np.meshgrid(BEAMS, 2.0 * np.pi * np.arange(STEPS) / STEPS, indexing="ij")
    d = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1)
    origin = np.array([ego, 0.0, HEIGHT])
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(d[..., 2] < 0.0, -HEIGHT / d[..., 2], np.inf)
        walls = np.where(d[..., 1] != 0.0, WALL / np.abs(d[..., 1]), np.inf)
    ranges = np.stack([ground, walls, to_box(np.array(CAR_SIZE) / 2.0, origin - [car, *CAR_AT[1:]], d)])
    nearest = ranges.min(axis=0)
    return np.where(nearest < FARTHEST, nearest, np.inf), np.array([GROUND, WALLS, CAR])[ranges.argmin(axis=0)]


def write_swept_street(folder: Path) -> Path:
    """Writes the drive folder, with the car's track, and returns it."""
    (folder / "sweeps").mkdir(parents=True)
    times = FIRST_US + KEY_FRAME_US * np.arange(KEY_FRAMES)
    seconds = (times - FIRST_US) * 1e-6
    for i, second in enumerate(seconds.tolist()):
        ranges, intensities = swept(SPEED * second, CAR_AT[0] + CAR_SPEED * second)
        rings, steps = np.nonzero(np.isfinite(ranges))
        up, around, r = BEAMS[rings], 2.0 * np.pi * steps / STEPS, ranges[rings, steps]
        x, y, z = r * np.cos(up) * np.cos(around), r * np.cos(up) * np.sin(around), r * np.sin(up)
        np.savez(folder / f"sweeps/{i}.npz", x=x, y=y, z=z, intensity=intensities[rings, steps], ring=rings)

    def poses(along: list[float], *rest: float) -> list[dict]:
        places = zip(times.tolist(), along, strict=True)
        return [{"timestamp": t, "translation": [x, *rest], "rotation": [1.0, 0.0, 0.0, 0.0]} for t, x in places]

    mount = {"translation": [0.0, 0.0, HEIGHT], "rotation": [1.0, 0.0, 0.0, 0.0]}
    car = poses((CAR_AT[0] + CAR_SPEED * seconds).tolist(), *CAR_AT[1:])
    drive = {
        "format": "drivesplat drive", "version": 1,
        "lidars": {"top": {"sensor_to_ego": mount, "beam_elevations": BEAMS.tolist(), "azimuth_steps": STEPS}},
        "ego_poses": poses((SPEED * seconds).tolist(), 0.0, 0.0),
        "sweeps": [{"lidar": "top", "timestamp": t, "file": f"sweeps/{i}.npz"} for i, t in enumerate(times.tolist())],
        "tracks": [{"id": "car", "class": "car", "size": CAR_SIZE, "poses": car}],
    }  # fmt: skip
    (folder / "drive.json").write_text(json.dumps(drive), encoding="utf-8")
    return folder
