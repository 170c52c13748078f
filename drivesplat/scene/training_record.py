"""What a training reads of a scene: the record in parser.pkl."""

from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.io.storage import read_plain_pickle, unreadable

_KEYS = {
    "Ks", "camtoworlds", "ego_to_world", "image_paths", "image_names", "image_sizes", "camera_names", "camera_indices",
    "timestamps", "sample_indices", "is_key_frame", "points", "points_rgb", "scene_scale", "splits",
    "held_out_frames", "scene", "seed",
}  # fmt: skip


def image_size(parser: dict[str, Any], index: int | np.integer) -> tuple[int, int]:
    """Width and height in pixels at which image `index` of a parser record is trained and measured."""
    width, height = parser["image_sizes"][index].tolist()
    return width, height


def read_parser(path: str | Path) -> dict[str, Any]:
    """Reads `parser.pkl`. Raises ResultError where it is not one, or holds anything but plain data and arrays."""
    content = read_plain_pickle(path, rule="parser")
    if not isinstance(content, dict) or not content.keys() >= _KEYS:
        raise unreadable(path, "parser", "it lacks the keys of a parser record")
    return content
