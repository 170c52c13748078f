"""Compares a converted drive with the vehicle that turns in the tiny world."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.readers.drive.check import check, whole_scene
from drivesplat.readers.drive.format import read_drive
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.images import read_image
from drivesplat.scene.rigid import apply, rigid
from drivesplat.scene.scene import Scene
from helpers.drives import TILTED_CAMERA, TIMES, World, seconds_of
from helpers.table_files import time_limit


def origin_of(scene: Scene, drive: World) -> np.ndarray:
    """The scene's origin in the drive's world, by the first image."""
    first = scene.frames[0]
    return drive.ego(first.timestamp)[:3, 3] - first.ego_to_world[:3, 3]


def assert_shows(scene: Scene, drive: World, delay: int, lidars: dict[str, np.ndarray], atol: float) -> None:
    """Poses, calibration, images and boxes of a scene are those of a drive whose images are `delay` microseconds after
    its key frames, up to the origin, which is near the first ego position."""
    origin = origin_of(scene, drive)
    assert np.linalg.norm(scene.frames[0].ego_to_world[:3, 3]) < 0.1

    def here(pose: np.ndarray) -> np.ndarray:
        return rigid(pose[:3, :3], pose[:3, 3] - origin)

    assert [frame.timestamp for frame in scene.frames] == (TIMES + delay).tolist()
    for frame in scene.frames:
        np.testing.assert_allclose(frame.intrinsics, drive.intrinsics, atol=1e-9)
        np.testing.assert_allclose(frame.ego_to_world, here(drive.ego(frame.timestamp)), atol=atol)
        np.testing.assert_allclose(frame.camera_to_world, here(drive.ego(frame.timestamp) @ TILTED_CAMERA), atol=atol)
        expected = drive.image(seconds_of(frame.timestamp), TILTED_CAMERA)
        assert np.abs(read_image(frame.image_path).astype(int) - expected).mean() < 3.0
    for sweep in scene.sweeps:
        np.testing.assert_allclose(
            sweep.sensor_to_world, here(drive.ego(sweep.timestamp) @ lidars[sweep.lidar]), atol=atol
        )
    assert len(scene.tracks) == len(drive.things)
    for track, thing in zip(scene.tracks, drive.things, strict=True):
        np.testing.assert_allclose(track.size, thing.size, atol=1e-6)
        assert len(track.timestamps) >= 5
        for time, box in zip(track.timestamps, track.object_to_world, strict=True):
            np.testing.assert_allclose(box, here(drive.box(thing, time)), atol=atol)


def world_points(scene: Scene, number: int, drive: World) -> np.ndarray:
    """The returns of a sweep in the drive's world."""
    sweep = scene.sweeps[number]
    return apply(sweep.sensor_to_world, read_returns(sweep).points) + origin_of(scene, drive)


def require_refused_or_sound(convert: Callable[[], int], out: Path, capsys: Any, done: str) -> None:
    """A damaged recording is refused in one line, or gives a folder whose faults `check` lists, or finite values."""
    with time_limit():
        status = convert()
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: ")]
    if status:
        assert len(said) == 1 and 10 < len(said[0]) < 1200 and "Traceback" not in said[0], done
        assert not (out / "drive.json").exists(), done
        return
    assert not said, done
    with time_limit():
        if check(out, None):
            return
        scene = whole_scene(read_drive(out), out)
        poses = [frame.camera_to_world for frame in scene.frames] + [sweep.sensor_to_world for sweep in scene.sweeps]
        poses += [pose for track in scene.tracks for pose in track.object_to_world]
        assert np.isfinite(poses).all() and np.abs(poses).max() < 1e9, done
        for pose in poses:
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6, err_msg=done)
        for sweep in scene.sweeps:
            assert len(read_returns(sweep).points) and np.abs(read_returns(sweep).points).max() < 2000.0, done
