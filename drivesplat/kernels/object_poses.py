"""Poses of objects: annotated ones with learned corrections, and the rotations of spherical harmonics that go with
them, in few kernels, which every training iteration runs."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.quaternions import about_vertical, left_factor


def corrected(
    quats: Float[Tensor, "a 4"],
    translations: Float[Tensor, "a 3"],
    weights: Float[Tensor, " m"],
    owner: Int[Tensor, " m"],
    yaw: Float[Tensor, " m"],
    shifts: Float[Tensor, "m 3"],
) -> tuple[Float[Tensor, "a 4"], Float[Tensor, "a 3"]]:
    """Poses of a objects, object to world, with corrections that are sums over their annotations.

    `quats` (w, x, y, z) and `translations` (metres) are the annotated poses at one time. `weights` are those that each
    of m annotations has at that time, `owner` its object, `yaw` its correction about the object's vertical axis
    (radians) and `shifts` those along the world's axes (metres). Gradients reach `yaw` and `shifts`.
    """
    if triton_support.usable_for(yaw):
        from drivesplat.kernels.triton.object_poses import Corrected

        return Corrected.apply(quats, translations, weights, owner, yaw, shifts)
    of_objects = weights * (owner == torch.arange(len(quats), device=owner.device)[:, None])
    turns = about_vertical(of_objects @ yaw)
    return (left_factor(quats) @ turns[..., None])[..., 0], translations + of_objects @ shifts


def fused_rotation_of_harmonics(quats: Float[Tensor, "a 4"], coefficients: int) -> Float[Tensor, "a k k"] | None:
    """The maps of k `coefficients` of harmonics under unit quaternions, object to world, as
    `drivesplat.model.harmonics.rotation_of_harmonics`. Returns None where the kernel does not apply; it needs Triton,
    and 1 or 4 coefficients."""
    if coefficients not in (1, 4) or not triton_support.usable_for(quats):
        return None
    from drivesplat.kernels.triton.object_poses import rotation_of_harmonics

    return rotation_of_harmonics(quats, coefficients)
