"""Sums of squares of learned corrections of tracks, in few tensor operations, which every training iteration runs."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.constants import constant


def sums_of_squares(
    shifts: Float[Tensor, "m 3"],
    yaw: Float[Tensor, " m"],
    neighbours: Int[Tensor, "q 3"],
    sigma_shift: float,
    sigma_yaw: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Of corrections of positions (metres) and headings (radians), in units of their sigmas: the sum of their squares,
    and that of their second differences, for which `neighbours` are all triples of consecutive annotations."""
    if triton_support.usable_for(yaw):
        from drivesplat.kernels.triton.track_penalties import SumsOfSquares

        return SumsOfSquares.apply(shifts, yaw, neighbours, 1.0 / sigma_shift, 1.0 / sigma_yaw)
    off = torch.cat([shifts, yaw[:, None]], dim=1) / constant((sigma_shift,) * 3 + (sigma_yaw,), yaw.device)
    threes = off.index_select(0, neighbours.flatten()).reshape(-1, 3, 4)
    bends = (threes * constant((1.0, -2.0, 1.0), yaw.device)[:, None]).sum(dim=1)
    return _of(off), _of(bends)


def _of(values: Float[Tensor, "n 4"]) -> Float[Tensor, ""]:
    return values.flatten().dot(values.flatten())
