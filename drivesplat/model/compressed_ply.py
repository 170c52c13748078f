"""Gaussians from .compressed.ply, the packed format of PlayCanvas and SuperSplat.

The element `chunk` has the bounds of positions, logarithms of scales and, in newer files, colours of 256 Gaussians.
A vertex has four numbers of 32 bits: position and scale (11, 10 and 11 bits within the bounds), rotation (the number of
the largest component of w, x, y, z in 2 bits, the others in 10 bits each within ±√½), and colour with opacity (8 bits
each). The element `sh` has further harmonics in 8 bits within ±4.
"""

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData

from drivesplat.model.gaussians import Gaussians

CHUNK = 256
SH_C0 = 0.28209479177387814
"""The constant spherical harmonic."""


def unpacked(data: PlyData) -> Gaussians:
    """The Gaussians of a file of this format, on the CPU. Raises KeyError or ValueError for a damaged one."""
    vertices = data["vertex"]
    count = len(vertices.data)
    chunks = data["chunk"]
    if len(chunks.data) * CHUNK < count:
        raise ValueError(f"{len(chunks.data)} chunks for {count} Gaussians")
    of_chunk = np.arange(count) // CHUNK

    def bounded(values: np.ndarray, names: tuple[str, str, str]) -> np.ndarray:
        low, high = (
            np.stack([np.asarray(chunks[f"{side}_{name}"], dtype=np.float64) for name in names], axis=1)[of_chunk]
            for side in ("min", "max")
        )
        return low * (1.0 - values) + high * values

    position, rotation, scale, color = (
        np.asarray(vertices[f"packed_{name}"]).astype(np.int64) for name in ("position", "rotation", "scale", "color")
    )
    rgba = _fractions(color, (8, 8, 8, 8))
    rgb = rgba[:, :3]
    if "max_b" in chunks:
        rgb = bounded(rgb, ("r", "g", "b"))
    others = (_fractions(rotation, (10, 10, 10)) - 0.5) * np.sqrt(2.0)
    largest = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))
    quats, index = np.empty((count, 4)), (rotation >> 30) & 3
    at = np.arange(4) == index[:, None]
    quats[at], quats[~at] = largest, others.ravel()
    columns = (
        bounded(_fractions(position, (11, 10, 11)), ("x", "y", "z")),
        quats,
        np.exp(bounded(_fractions(scale, (11, 10, 11)), ("scale_x", "scale_y", "scale_z"))),
        rgba[:, 3],
        ((rgb - 0.5) / SH_C0)[:, None],
        _harmonics(data, count),
    )
    if not all(np.isfinite(column).all() for column in columns):
        raise ValueError("it contains NaN or Inf")
    return Gaussians(*(torch.from_numpy(column.astype(np.float32)) for column in columns))


def _fractions(packed: np.ndarray, bits: tuple[int, ...]) -> Float[np.ndarray, "n values"]:
    """Numbers in [0, 1] from fields of these widths, the last in the lowest bits."""
    shifts = np.cumsum((0, *bits[:0:-1]))[::-1]
    most = 2 ** np.array(bits) - 1
    return ((packed[:, None] >> shifts) & most) / most


def _harmonics(data: PlyData, count: int) -> Float[np.ndarray, "n coefficients 3"]:
    """The harmonics beyond the constant one."""
    if "sh" not in data:
        return np.zeros((count, 0, 3))
    rest = data["sh"]
    values = np.stack([np.asarray(rest[f"f_rest_{i}"]) for i in range(len(rest.properties))], axis=1)
    if values.shape[1] not in (9, 24, 45) or len(values) != count:
        raise ValueError(f"its harmonics are {values.shape[1]} of {len(values)} Gaussians")
    return (values * (8.0 / 255.0) - 4.0).reshape(count, 3, -1).transpose(0, 2, 1)
