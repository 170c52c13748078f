"""The split of images and LiDAR sweeps: key frames are held out as a whole, and recordings near them excluded."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.settings.images import NEIGHBOURHOOD_HZ, HoldoutSettings

Group = Literal["train", "interpolation", "extrapolation", "side_camera", "excluded"]
HELD_OUT_GROUPS: tuple[Group, Group] = ("interpolation", "extrapolation")
SIDE_CAMERA: Group = "side_camera"
"""The group of images of `holdout.cameras` at times at which other cameras have training images."""


def held_out_key_frames(scene: Scene, holdout: HoldoutSettings) -> dict[str, list[int]]:
    """The held-out key frames of a scene by group: those of the scene itself, where it has some, else of the
    settings."""
    if scene.held_out is None:
        return holdout.held_out(len(scene.key_frame_timestamps))
    return {group: scene.held_out.get(group, []) for group in HELD_OUT_GROUPS}


def frame_groups(scene: Scene, holdout: HoldoutSettings) -> list[Group]:
    """The group of every image of the scene, in the order of `scene.frames`. What would be 'train' is 'side_camera' for
    images of `holdout.cameras`."""
    groups = _groups(scene, scene.frames, holdout)
    return [
        SIDE_CAMERA if group == "train" and frame.camera in holdout.cameras else group
        for frame, group in zip(scene.frames, groups, strict=True)
    ]


def training_images(scene: Scene, holdout: HoldoutSettings) -> np.ndarray:
    """The indices (n,) in `scene.frames` of the training images."""
    return np.flatnonzero([group == "train" for group in frame_groups(scene, holdout)])


def last_training_timestamp(scene: Scene, camera: str, holdout: HoldoutSettings) -> int | None:
    """The timestamp in microseconds of a camera's last training image; None if there is none."""
    frames = (scene.frames[i] for i in training_images(scene, holdout))
    return max((frame.timestamp for frame in frames if frame.camera == camera), default=None)


def sweep_groups(scene: Scene, holdout: HoldoutSettings) -> list[Group]:
    """The group of every LiDAR sweep of the scene, in the order of `scene.sweeps`."""
    return _groups(scene, scene.sweeps, holdout)


def _groups(scene: Scene, records: Sequence[Frame | Sweep], holdout: HoldoutSettings) -> list[Group]:
    """The group of each image or sweep: that of a held-out key frame; 'excluded' if nearer to one than the
    neighbourhood; else 'train'.

    The neighbourhood is half a key-frame interval below NEIGHBOURHOOD_HZ, else `holdout.neighbourhood_s`.
    """
    held_out = held_out_key_frames(scene, holdout) if scene.held_out is None else scene.held_out
    group_of_key_frame = {i: group for group, indices in held_out.items() for i in indices}
    held_out_times = scene.key_frame_timestamps[sorted(group_of_key_frame)]
    dense = scene.key_frame_hz >= NEIGHBOURHOOD_HZ
    neighbourhood = holdout.neighbourhood_s * 1e6 if dense else scene.key_frame_interval / 2.0
    groups: list[Group] = []
    for record in records:
        held: Any = group_of_key_frame.get(record.sample_index) if record.is_key_frame else None
        may_be_near = not record.is_key_frame or dense
        if held is None and may_be_near and np.any(np.abs(held_out_times - record.timestamp) < neighbourhood):
            held = "excluded"
        groups.append(held or "train")
    return groups
