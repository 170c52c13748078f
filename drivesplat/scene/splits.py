"""The split of images and LiDAR sweeps: key frames are held out as a whole, and recordings near them excluded."""

from typing import Literal

import numpy as np

from drivesplat.scene.scene import Scene
from drivesplat.settings.holdout import HoldoutSettings

Group = Literal["train", "interpolation", "extrapolation", "excluded"]
NEIGHBOURHOOD_HZ = 5.0
"""Key frames a second from which `holdout.neighbourhood_s` applies."""
HELD_OUT_GROUPS: tuple[Group, Group] = ("interpolation", "extrapolation")


def held_out_key_frames(count: int, holdout: HoldoutSettings) -> dict[str, list[int]]:
    """Held-out indices by group, of `count` key frames. A key frame in both groups belongs to the last block."""
    block = list(range(max(0, count - holdout.last_block), count))
    nth = range(holdout.offset, count, holdout.every_nth) if holdout.every_nth else range(0)
    return {"interpolation": [i for i in nth if i not in block], "extrapolation": block}


def group_of_times(
    scene: Scene, timestamps: np.ndarray, sample_indices: np.ndarray, is_key_frame: np.ndarray, holdout: HoldoutSettings
) -> list[Group]:
    """The group of each image or sweep: that of a held-out key frame; 'excluded' if nearer to one than the
    neighbourhood; else 'train'.

    The neighbourhood is half a key-frame interval below NEIGHBOURHOOD_HZ, else `holdout.neighbourhood_s`.
    `timestamps` (n,) microseconds, `sample_indices` (n,), `is_key_frame` (n,).
    """
    held_out = held_out_key_frames(len(scene.key_frame_timestamps), holdout)
    group_of_key_frame = {i: group for group, indices in held_out.items() for i in indices}
    held_out_times = scene.key_frame_timestamps[sorted(group_of_key_frame)]
    dense = scene.key_frame_hz >= NEIGHBOURHOOD_HZ
    neighbourhood = holdout.neighbourhood_s * 1e6 if dense else scene.key_frame_interval / 2.0
    groups: list[Group] = []
    for time, index, key in zip(timestamps, sample_indices, is_key_frame, strict=True):
        if key and int(index) in group_of_key_frame:
            groups.append(group_of_key_frame[int(index)])
        else:
            near = np.any(np.abs(held_out_times - time) < neighbourhood)
            groups.append("excluded" if near and (dense or not key) else "train")
    return groups


def frame_groups(scene: Scene, holdout: HoldoutSettings) -> list[Group]:
    """The group of every image of the scene, in the order of `scene.frames`."""
    return _groups(scene, scene.frames, holdout)


def training_images(scene: Scene, holdout: HoldoutSettings) -> np.ndarray:
    """The indices (n,) in `scene.frames` of the training images."""
    return np.flatnonzero([group == "train" for group in frame_groups(scene, holdout)])


def sweep_groups(scene: Scene, holdout: HoldoutSettings) -> list[Group]:
    """The group of every LiDAR sweep of the scene, in the order of `scene.sweeps`."""
    return _groups(scene, scene.sweeps, holdout)


def _groups(scene: Scene, records: tuple, holdout: HoldoutSettings) -> list[Group]:
    return group_of_times(
        scene,
        np.array([r.timestamp for r in records], dtype=np.int64),
        np.array([r.sample_index for r in records], dtype=np.int64),
        np.array([r.is_key_frame for r in records], dtype=bool),
        holdout,
    )
