"""Short synthetic drives of some of the rig's cameras, recorded straight into a Scene."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.world.optics.rig import RigSensor
from drivesplat.world.recorder import Recorder
from drivesplat.world.street.objects import EGO_VEHICLE
from helpers import demo_worlds
from helpers.demo_worlds import RIG

START_US, KEY_FRAME_US = 1_000_000_000, 500_000
KEY_FRAMES = 14


def recorder_of(**world: Any) -> Recorder:
    """A small street with little traffic; `world` is laid over it."""
    return demo_worlds.recorder_of(**{"width": 160, "vehicles": 1, "pedestrians": 0, **world})


def rig_drive(folder: Path, cameras: Sequence[str], key_frames: int = KEY_FRAMES, **world: Any) -> Scene:
    """The key frames of a drive by `cameras` and the LiDAR, their files in `folder`."""
    recorder = recorder_of(**world)
    frames, sweeps = [], []
    for index in range(key_frames):
        frames += [_frame(folder, recorder, RIG[camera], index) for camera in cameras]
        sweeps.append(_sweep(folder, recorder, index))
    times = START_US + KEY_FRAME_US * np.arange(key_frames)
    return Scene(
        "rig", "demo", "v1.0-mini", "", np.zeros(3), times, tuple(frames), tuple(sweeps), (), "nuscenes", 2.0
    )  # fmt: skip


def _frame(folder: Path, recorder: Recorder, sensor: RigSensor, index: int) -> Frame:
    time_us = index * KEY_FRAME_US + sensor.delay_us
    camera = recorder.camera(sensor, time_us * 1e-6)
    path = folder / f"{sensor.channel}_{index:02}.png"
    Image.fromarray(recorder.image(sensor, time_us)).save(path)
    return Frame(
        sensor.channel, START_US + time_us, str(path), camera.width, camera.height, camera.intrinsics,
        camera.pose, recorder.ego_pose(time_us * 1e-6), True, index, path.stem,
    )  # fmt: skip


def _sweep(folder: Path, recorder: Recorder, index: int) -> Sweep:
    sensor, path = RIG["LIDAR_TOP"], folder / f"{index:02}.pcd.bin"
    recorder.sweep(sensor, index * KEY_FRAME_US).tofile(path)
    sensor_to_world = recorder.ego_pose(index * KEY_FRAME_US * 1e-6) @ sensor.sensor_to_ego
    time = START_US + index * KEY_FRAME_US
    return Sweep(str(path), time, sensor_to_world, True, index, path.stem, "LIDAR_TOP", "nuscenes")


@functools.cache
def true_body(camera: str) -> np.ndarray:
    """The pixels (h, w) bool in which a camera sees the ego vehicle, a second after the start; read only."""
    recorder = recorder_of(own_car=True)
    number = [thing.name for thing in recorder.objects].index(EGO_VEHICLE)
    body = recorder.geometry(RIG[camera], 1_000_000).objects == number
    body.setflags(write=False)
    return body
