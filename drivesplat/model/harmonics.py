"""Rotation of spherical harmonics with an object.

A colour function in an object's frame has the same degree in the world's frame: its coefficients are mapped linearly,
degree by degree. Rasterizing the rotated coefficients gives the colours that evaluation along directions in the
object's frame gives.
"""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.object_poses import fused_rotation_of_harmonics
from drivesplat.kernels.quaternions import rotation_matrix


def rotation_of_harmonics(rotations: Float[Tensor, "a 3 3"], coefficients: int) -> Float[Tensor, "a k k"]:
    """The maps of k `coefficients` under `rotations` (object to world): sh_world = map @ sh_object.

    Exact for every degree, by least squares over sufficiently many directions: with Y(d) the basis along directions d
    (rows), Y(d) sh_world = Y(R^T d) sh_object for all d. Entries between degrees are exactly 0, since Adam would
    amplify rounding errors.
    """
    if coefficients <= 4:
        return _of_vectors(rotations, coefficients)
    from drivesplat.kernels.gsplat_private import sh_basis  # late: stages report a missing gsplat

    directions, inverse, same_degree = _directions(coefficients, rotations.dtype, rotations.device)
    turned = directions @ rotations  # rows are R^T d
    return inverse @ sh_basis(coefficients, turned) * same_degree


def rotation_of_harmonics_by(
    quats: Float[Tensor, "a 4"], coefficients: int, side: Float[Tensor, " a"] | None = None
) -> Float[Tensor, "a k k"]:
    """`rotation_of_harmonics` by unit quaternions (w, x, y, z), object to world, of objects that are mirrored before
    (y to -y) where their `side` is -1. Without gradient."""
    quats = quats.detach()
    if side is not None and coefficients > 1:
        mirrors = torch.ones_like(quats[:, :3])
        mirrors[:, 1] = side
        return rotation_of_harmonics(rotation_matrix(quats) * mirrors[:, None], coefficients)
    fused = fused_rotation_of_harmonics(quats, coefficients)
    return rotation_of_harmonics(rotation_matrix(quats), coefficients) if fused is None else fused


def _of_vectors(rotations: Float[Tensor, "a 3 3"], coefficients: int) -> Float[Tensor, "a k k"]:
    """The maps of k = 1 or 4 coefficients: those of degree 1 are the components of a vector along -y, z and -x."""
    maps = rotations.new_zeros(len(rotations), coefficients, coefficients)
    maps[:, 0, 0] = 1.0
    if coefficients == 4:
        axes = _axes(rotations.dtype, rotations.device)
        maps[:, 1:, 1:] = axes @ rotations @ axes.T
    return maps


@cache
def _axes(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 3"]:
    """The directions along which the functions of degree 1 grow, as rows."""
    return torch.tensor([[0, -1, 0], [0, 0, 1], [-1, 0, 0]], dtype=dtype, device=device)


def rotated(sh: Float[Tensor, "n k 3"], object_to_world: Float[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """Coefficients in an object's frame as coefficients in the world's frame."""
    if sh.shape[1] == 1:
        return sh
    return rotation_of_harmonics(object_to_world[None].to(sh), sh.shape[1])[0] @ sh


@cache
def _directions(coefficients: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Directions (m, 3) spread over the sphere (a Fibonacci lattice), the pseudo-inverse (k, m) of their basis, and
    which coefficients (k, k) have the same degree."""
    from drivesplat.kernels.gsplat_private import sh_basis

    count = 4 * coefficients
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1.0 - 2.0 * index / count
    angle = index * (torch.pi * (3.0 - 5.0**0.5))
    ring = torch.sqrt(1.0 - z**2)
    directions = torch.stack([ring * torch.cos(angle), ring * torch.sin(angle), z], dim=-1)
    inverse = torch.linalg.pinv(sh_basis(coefficients, directions))
    degrees = torch.arange(coefficients).sqrt().long()
    same_degree = degrees[:, None] == degrees
    return directions.to(device, dtype), inverse.to(device, dtype), same_degree.to(device, dtype)
