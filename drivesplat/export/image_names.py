"""Names of recorded images in models for other programs."""

import os
from collections.abc import Sequence
from pathlib import Path

from drivesplat.scene.scene import Frame


def image_names(frames: Sequence[Frame]) -> list[str]:
    """The paths of the frames' images, relative to the deepest folder that contains all of them: unique, and the same
    wherever the dataset is."""
    folder = os.path.commonpath([Path(frame.image_path).parent for frame in frames])
    return [Path(frame.image_path).relative_to(folder).as_posix() for frame in frames]
