"""Depth and objects as 16-bit images."""

import numpy as np
from jaxtyping import Float, Int16, UInt16

from drivesplat.readers.truth import DEPTH_LIMIT, DEPTH_UNITS_PER_METRE


def depth_units(depth: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """Depths in metres in units of 1/256 m, 0 where there is none, as images of depth contain them."""
    return np.clip(depth * DEPTH_UNITS_PER_METRE + 0.5, 0, DEPTH_LIMIT).astype(np.uint16)


def numbered(indices: Int16[np.ndarray, "h w"], numbers: list[int]) -> UInt16[np.ndarray, "h w"]:
    """The number of each index, 0 for -1, as images of objects contain them."""
    return np.array([*numbers, 0], dtype=np.uint16)[indices]  # the last is what -1 finds
