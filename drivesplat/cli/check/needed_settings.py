"""The settings that a recording needs, to be laid over config.yaml."""

from typing import Any

import numpy as np
import yaml

from drivesplat.cli.check.chosen import DATASET, ChosenScene
from drivesplat.cli.check.reading import CheckedScene
from drivesplat.io.this_copy import of_the_workflow
from drivesplat.io.yaml_file import read_yaml
from drivesplat.readers.outline import Outline
from drivesplat.scene.scene import UNPOSED, Scene
from drivesplat.scene.splits import training_images
from drivesplat.settings.config import Config
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.workflow.gpus import any_gpu

MAX_WIDTH = 1600
"""Width in pixels to which wider images are resized."""
NARROWER = (1200, 800, 640)
"""Widths that are proposed where images take more than MAX_SHARE of the memory."""
MAX_SHARE = 0.4
"""The share of the memory that training images may take."""
LIDAR_ALONE = "presets/lidar.yaml"
"""The config file of the method for recordings without images."""
HOLDOUTS: tuple[dict[str, Any], ...] = (
    {},
    {"every_nth": 4, "offset": 2, "last_block": 1},
    {"every_nth": 0, "last_block": 1},
    {"every_nth": 0, "last_block": 1, "neighbourhood_s": 0.0},
)
"""Hold-outs, the default first, of which the first one that leaves enough key frames to train on is proposed."""
MIN_TRAINING = 2
"""Key frames of the evaluated camera that are trained on, at least, where some are held out."""


def needed_settings(chosen: ChosenScene, checked: CheckedScene, outline: Outline, memory_gb: float) -> dict[str, Any]:
    """The settings of a recording as a tree: the dataset, its cameras, and what differs from the defaults for it.
    `memory_gb` is the memory of the device that trains."""
    scene = checked.whole
    cameras = [camera.name for camera in scene.cameras if scene.key_frames(camera.name)]
    shipped = {"nuscenes": {"batch": False}} if chosen.dataset == DATASET else {}
    settings: dict[str, Any] = {
        "datasets": shipped | {chosen.dataset: _dataset(chosen)},
        "cameras": cameras,
        "eval_camera": scene.front_camera(cameras),
    }
    if not cameras:
        of_lidar = read_yaml(of_the_workflow(LIDAR_ALONE), "preset") or {}
        settings["methods"] = {"vanilla": None, "street": None, **of_lidar["methods"]}
    if checked.faults_of_images:
        settings["extract"] = {"on_missing": "warn"}
    if not scene.sweeps or checked.faults_of_sweeps:
        settings["lidar_seed"] = {"on_missing": "warn"}
    if scene.poses == UNPOSED:
        settings["refine_poses"] = {"enabled": True, "start": "images"}
    if cameras:
        settings |= _image_settings(scene, settings["eval_camera"], outline, memory_gb)
    if not any_gpu():
        settings["device"] = {"kind": "cpu"}
    return settings


def lacking_settings(config: Config, needed: dict[str, Any]) -> dict[str, Any]:
    """Those settings about missing files and poses that a recording needs and the `config` of its scene has not."""
    given = config.model_dump(mode="json")
    about = {name: needed[name] for name in ("extract", "lidar_seed", "refine_poses") if name in needed}
    return {name: wanted for name, wanted in about.items() if any(given[name][key] != wanted[key] for key in wanted)}


def as_yaml(settings: dict[str, Any]) -> str:
    """Settings as the text of a config file."""
    return yaml.safe_dump(settings, sort_keys=False, allow_unicode=True, width=120)


def _dataset(chosen: ChosenScene) -> dict[str, Any]:
    found: dict[str, Any] = {"reader": chosen.reader, "dataroot": str(chosen.root.absolute()), "scenes": [chosen.name]}
    if chosen.version:
        found["version"] = chosen.version
    if chosen.dataset != DATASET:
        found["world"] = None  # that of config.yaml may be generated
    return found | ({"frames": {chosen.name: list(chosen.frames)}} if chosen.frames else {})


def _image_settings(scene: Scene, eval_camera: str, outline: Outline, memory_gb: float) -> dict[str, Any]:
    """The size of images, and the hold-out."""
    found: dict[str, Any] = {}
    cameras, frame = list(outline.cameras), scene.frames[scene.middle_key_frame(eval_camera)]
    width = min(frame.width, MAX_WIDTH)
    for narrower in (width, *(other for other in NARROWER if other < width)):
        width = narrower
        if outline.image_bytes(cameras, ImageSettings(width=width), False) * 1e-9 <= MAX_SHARE * memory_gb:
            break
    if width < frame.width:
        found["images"] = {"width": width}
    for changes in HOLDOUTS:
        holdout = HoldoutSettings(**changes)
        trained = {
            scene.frames[i].sample_index
            for i in training_images(scene, holdout)
            if scene.frames[i].camera == eval_camera
        }
        held_out = np.concatenate(list(holdout.held_out(len(scene.key_frame_timestamps)).values()))
        if len(trained) >= MIN_TRAINING and len(held_out):
            break
    else:
        changes = {"every_nth": 0, "last_block": 0}
    return found | ({"holdout": changes} if changes else {})
