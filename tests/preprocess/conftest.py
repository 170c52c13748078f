"""Drives whose held-out recordings are worthless."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import frame_groups, sweep_groups
from drivesplat.settings.images import HoldoutSettings


@pytest.fixture
def spoilt(tiny_scene, tmp_path) -> Callable[[HoldoutSettings, np.ndarray], Scene]:
    """The tiny drive whose held-out images are magenta and whose held-out sweeps hold `returns` (n, 5) instead."""

    def made(holdout: HoldoutSettings, returns: np.ndarray) -> Scene:
        image, sweep = tmp_path / "magenta.png", tmp_path / "garbage.pcd.bin"
        Image.new("RGB", (96, 54), (255, 0, 255)).save(image)
        returns.astype(np.float32).tofile(sweep)
        frames, sweeps = tiny_scene.frames, tiny_scene.sweeps
        groups = frame_groups(tiny_scene, holdout), sweep_groups(tiny_scene, holdout)
        counts = [len(group) - list(group).count("train") for group in groups]
        assert counts == [4 + 3, 4], "images at 2, 6, 8, 9, between 2-3, 6-7, 8-9; four sweeps"
        return dataclasses.replace(
            tiny_scene,
            frames=tuple(
                frame if group == "train" else dataclasses.replace(frame, image_path=str(image))
                for frame, group in zip(frames, groups[0], strict=True)
            ),
            sweeps=tuple(
                one if group == "train" else dataclasses.replace(one, path=str(sweep))
                for one, group in zip(sweeps, groups[1], strict=True)
            ),
        )

    return made
