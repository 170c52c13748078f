"""The settings that a drive folder needs, as a file to copy."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drivesplat.scene.scene import UNPOSED, Scene
from drivesplat.scene.splits import held_out_key_frames, training_images
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.names import require_name

MAX_WIDTH = 1600
"""Width in pixels to which wider images are resized."""
HOLDOUTS: tuple[dict[str, Any], ...] = (
    {},
    {"every_nth": 4, "offset": 2, "last_block": 1},
    {"every_nth": 0, "last_block": 1},
    {"every_nth": 0, "last_block": 1, "neighbourhood_s": 0.0},
)
"""Hold-outs, the default first, of which the first one that leaves enough key frames to train on is proposed."""
MIN_TRAINING = 2
"""Key frames of the evaluated camera that are trained on, at least, where some are held out."""


def needed_settings(scene: Scene, folder: Path) -> str:
    """The settings of a drive in `folder` as YAML, to be laid over config.yaml: the data set, its cameras, and what
    differs from the defaults for it. The scene is called after the folder, `drive` where that cannot name one."""
    cameras = [camera.name for camera in scene.cameras if scene.key_frames(camera.name)]
    settings: dict[str, Any] = {
        "datasets": {"mine": {"reader": "drive", "dataroot": str(folder.absolute()), "scenes": [scene_name(folder)]}},
        "cameras": cameras,
        "eval_camera": _camera_ahead(scene, cameras) if cameras else None,
    }
    if not scene.sweeps:
        settings["lidar_seed"] = {"on_missing": "warn"}
    if scene.poses == UNPOSED:
        settings["refine_poses"] = {"enabled": True, "start": "images"}
    if cameras:
        frame = scene.frames[scene.middle_key_frame(settings["eval_camera"])]
        if frame.width > MAX_WIDTH:
            settings["images"] = {"width": MAX_WIDTH}
        if holdout := _holdout(scene, settings["eval_camera"]):
            settings["holdout"] = holdout
    return yaml.safe_dump(settings, sort_keys=False, allow_unicode=True, width=120)


def scene_name(folder: Path) -> str:
    """The name of the scene in a drive folder."""
    try:
        require_name(folder.absolute().name, "scene")
    except ValueError:
        return "drive"
    return folder.absolute().name


def _camera_ahead(scene: Scene, cameras: list[str]) -> str:
    """The camera that looks ahead most."""
    ahead = {frame.camera: float(frame.camera_to_ego[0, 2]) for frame in scene.frames if frame.camera in cameras}
    return max(cameras, key=lambda camera: round(ahead[camera], 1))


def _holdout(scene: Scene, camera: str) -> dict[str, Any]:
    """What differs from the default hold-out; empty where that leaves enough key frames to train on."""
    for changes in HOLDOUTS:
        holdout = HoldoutSettings(**changes)
        trained = {
            scene.frames[i].sample_index for i in training_images(scene, holdout) if scene.frames[i].camera == camera
        }
        held_out = np.concatenate(list(held_out_key_frames(len(scene.key_frame_timestamps), holdout).values()))
        if len(trained) >= MIN_TRAINING and len(held_out):
            return changes
    return {"every_nth": 0, "last_block": 0}
