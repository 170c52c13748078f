"""The settings that a drive folder needs, as a file to copy."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drivesplat.scene.scene import UNPOSED, Scene
from drivesplat.scene.splits import training_images
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
    name = folder.absolute().name
    try:
        require_name(name, "scene")
    except ValueError:
        name = "drive"
    cameras = [camera.name for camera in scene.cameras if scene.key_frames(camera.name)]
    ahead = {frame.camera: round(float(frame.camera_to_ego[0, 2]), 1) for frame in scene.frames}
    settings: dict[str, Any] = {
        "datasets": {"mine": {"reader": "drive", "dataroot": str(folder.absolute()), "scenes": [name]}},
        "cameras": cameras,
        "eval_camera": max(cameras, key=ahead.__getitem__) if cameras else None,
    }
    if not scene.sweeps:
        settings["lidar_seed"] = {"on_missing": "warn"}
    if scene.poses == UNPOSED:
        settings["refine_poses"] = {"enabled": True, "start": "images"}
    if cameras:
        frame = scene.frames[scene.middle_key_frame(settings["eval_camera"])]
        if frame.width > MAX_WIDTH:
            settings["images"] = {"width": MAX_WIDTH}
        for changes in HOLDOUTS:
            holdout = HoldoutSettings(**changes)
            chosen = (scene.frames[i] for i in training_images(scene, holdout))
            trained = {frame.sample_index for frame in chosen if frame.camera == settings["eval_camera"]}
            held_out = np.concatenate(list(holdout.held_out(len(scene.key_frame_timestamps)).values()))
            if len(trained) >= MIN_TRAINING and len(held_out):
                break
        else:
            changes = {"every_nth": 0, "last_block": 0}
        if changes:
            settings["holdout"] = changes
    return yaml.safe_dump(settings, sort_keys=False, allow_unicode=True, width=120)
