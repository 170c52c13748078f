"""Rotations as quaternions w, x, y, z, in few tensor operations, which every training iteration runs."""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor


def left_factor(quats: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4 4"]:
    """The matrices by which quaternions multiply others from the left: `left_factor(a) @ b` rotates by b, then by a."""
    return torch.einsum("...i,ijk->...kj", quats, _products(quats.dtype, quats.device))


def rotation_matrix(quats: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3 3"]:
    """The rotations of unit quaternions: v to q v q*."""
    return torch.einsum("...i,...j,ijkl->...kl", quats, quats, _rotations(quats.dtype, quats.device))


def rotated_back(quats: Float[Tensor, "*n 4"], vectors: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Vectors rotated by the inverses of unit quaternions: v to q* v q. Elementwise, since a GPU multiplies a million
    small matrices slowly."""
    axis = quats[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    return vectors - quats[..., :1] * twice + torch.linalg.cross(axis, twice)


def turned(quats: Float[Tensor, "n 4"], turns: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """The products (1, turn) * quaternion: rotations followed by those of `turns`, which are halved rotation vectors
    where they are small. The results are longer than `quats`. Elementwise, as `rotated_back`."""
    scalar, axis = quats[:, :1], quats[:, 1:]
    rotated = axis + scalar * turns + torch.linalg.cross(turns, axis)
    return torch.cat([scalar - (turns * axis).sum(dim=1, keepdim=True), rotated], dim=1)


def about_vertical(angles: Float[Tensor, "*n"]) -> Float[Tensor, "*n 4"]:
    """Rotations by `angles` (radians) about z."""
    half, nothing = 0.5 * angles, torch.zeros_like(angles)
    return torch.stack([torch.cos(half), nothing, nothing, torch.sin(half)], dim=-1)


@cache
def _products(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "4 4 4"]:
    """Hamilton's table: unit i times unit j is the sum over k of [i, j, k] times unit k."""
    table = torch.zeros(4, 4, 4, dtype=dtype)
    for unit in range(4):
        table[0, unit, unit] = table[unit, 0, unit] = 1.0
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        table[i, i, 0] = -1.0
        table[i, j, k], table[j, i, k] = 1.0, -1.0
    return table.to(device)


@cache
def _rotations(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "4 4 3 3"]:
    """The coefficient of q_i q_j in entry k, l of the matrix of v to q v q*."""
    table = _products(dtype, torch.device("cpu"))
    conjugate = torch.diag(torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=dtype))
    # unit i times axis l gives units m; m times the conjugate of unit j gives units k
    full = torch.einsum("ilm,mnk,nj->ijkl", table[:, 1:], table, conjugate)
    return full[:, :, 1:].to(device)
