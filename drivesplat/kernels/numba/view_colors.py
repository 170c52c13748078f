"""Colors from spherical harmonics, and their gradients.

The real basis up to degree 3 with the signs of Kerbl et al. 2023; see Sloan, "Efficient Spherical Harmonic Evaluation"
(JCGT 2013). Arithmetic and `no_type_check`: as in projection.py.
"""

import math
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.cache import callee, kernel
from drivesplat.kernels.numba.projection import arrays
from drivesplat.kernels.numba.threads import parallel_for

MAX_DEGREE = 3
CHUNK = 2048
"""Gaussians per chunk; sums over Gaussians are made chunk by chunk."""

C0 = 0.5 / math.sqrt(math.pi)
C1 = math.sqrt(3.0 / (4.0 * math.pi))
C2 = math.sqrt(15.0 / (4.0 * math.pi))
C20 = math.sqrt(5.0 / (16.0 * math.pi))
C3 = math.sqrt(35.0 / (32.0 * math.pi))
C31 = math.sqrt(21.0 / (32.0 * math.pi))
C32 = math.sqrt(105.0 / (4.0 * math.pi))
C30 = math.sqrt(7.0 / (16.0 * math.pi))


class NumbaViewColors(torch.autograd.Function):
    """The colors (c, n, 3), at least 0, that each camera sees of Gaussians with coefficients (n, k, 3).

    Gaussians with radius 0 are out of view; their colors are 0.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Float[Tensor, "n 3"],
        coefficients: Float[Tensor, "n k 3"],
        viewmats: Float[Tensor, "c 4 4"],
        radii: Int[Tensor, "c n 2"],
        degree: int,
    ) -> Float[Tensor, "c n 3"]:
        colors = means.new_empty((len(viewmats), len(means), 3))
        inputs = arrays(means, coefficients)
        for c in range(len(viewmats)):
            parallel_for(
                _view_colors, len(means), CHUNK, *inputs, _center(viewmats[c]), *arrays(radii[c], colors[c]), degree
            )
        ctx.save_for_backward(means, coefficients, viewmats, radii)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        means, coefficients, viewmats, radii = ctx.saved_tensors
        inputs = arrays(means, coefficients)
        v_means = torch.zeros_like(means, memory_format=torch.contiguous_format)
        v_coefficients = torch.zeros_like(coefficients, memory_format=torch.contiguous_format)
        v_viewmats = torch.zeros_like(viewmats, memory_format=torch.contiguous_format)
        for c in range(len(viewmats)):
            sums = np.zeros((-(-len(means) // CHUNK), 3))
            parallel_for(
                _view_colors_backward, len(means), CHUNK,
                *inputs, _center(viewmats[c]), *arrays(radii[c], v_colors[c], v_means, v_coefficients),
                sums, ctx.degree,
            )  # fmt: skip
            v_direction = torch.from_numpy(sums.sum(axis=0)).to(viewmats)  # of mean - center = mean + Wᵀ t, all summed
            v_viewmats[c, :3, 3] = viewmats[c, :3, :3] @ v_direction
            v_viewmats[c, :3, :3] = torch.outer(viewmats[c, :3, 3], v_direction)
        return v_means, v_coefficients, v_viewmats, None, None


def _center(viewmat: Float[Tensor, "4 4"]) -> np.ndarray:
    view = viewmat.detach().double().numpy()
    return -view[:3, :3].T @ view[:3, 3]


@callee
@no_type_check
def _direction(mean, center):
    """The unit vector from the camera to `mean`, and their distance."""
    x, y, z = mean[0] - center[0], mean[1] - center[1], mean[2] - center[2]
    distance = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return x / distance, y / distance, z / distance, distance


@callee
@no_type_check
def _basis(degree, x, y, z, basis):
    basis[0] = C0
    if degree >= 1:
        basis[1], basis[2], basis[3] = -C1 * y, C1 * z, -C1 * x
    if degree >= 2:
        basis[4], basis[5], basis[7] = C2 * x * y, -C2 * y * z, -C2 * x * z
        basis[6], basis[8] = C20 * (2.0 * z * z - x * x - y * y), 0.5 * C2 * (x * x - y * y)
    if degree >= 3:
        basis[9], basis[15] = -C3 * y * (3.0 * x * x - y * y), -C3 * x * (x * x - 3.0 * y * y)
        basis[10], basis[14] = C32 * x * y * z, 0.5 * C32 * z * (x * x - y * y)
        zonal = 4.0 * z * z - x * x - y * y
        basis[11], basis[13] = -C31 * y * zonal, -C31 * x * zonal
        basis[12] = C30 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)


@callee
@no_type_check
def _basis_backward(degree, x, y, z, v):
    """The gradient of x, y and z, taken as independent, from that of the basis."""
    v_x, v_y, v_z = 0.0, 0.0, 0.0
    if degree >= 1:
        v_x, v_y, v_z = -C1 * v[3], -C1 * v[1], C1 * v[2]
    if degree >= 2:
        v_x += C2 * (y * v[4] - z * v[7] + x * v[8]) - 2.0 * C20 * x * v[6]
        v_y += C2 * (x * v[4] - z * v[5] - y * v[8]) - 2.0 * C20 * y * v[6]
        v_z += C2 * (-y * v[5] - x * v[7]) + 4.0 * C20 * z * v[6]
    if degree >= 3:
        zonal = 4.0 * z * z - x * x - y * y
        v_x += -C3 * (6.0 * x * y * v[9] + 3.0 * (x * x - y * y) * v[15]) + C32 * z * (y * v[10] + x * v[14])
        v_x += C31 * (2.0 * x * y * v[11] + (2.0 * x * x - zonal) * v[13]) - 6.0 * C30 * x * z * v[12]
        v_y += C3 * (6.0 * x * y * v[15] - 3.0 * (x * x - y * y) * v[9]) + C32 * z * (x * v[10] - y * v[14])
        v_y += C31 * (2.0 * x * y * v[13] + (2.0 * y * y - zonal) * v[11]) - 6.0 * C30 * y * z * v[12]
        v_z += C32 * (x * y * v[10] + 0.5 * (x * x - y * y) * v[14]) - 8.0 * C31 * z * (y * v[11] + x * v[13])
        v_z += 3.0 * C30 * (2.0 * z * z - x * x - y * y) * v[12]
    return v_x, v_y, v_z


@callee
@no_type_check
def _color(basis, used, coefficients):
    """Red, green and blue before they are limited to 0 or more."""
    red, green, blue = 0.5, 0.5, 0.5
    for k in range(used):
        red += basis[k] * coefficients[k, 0]
        green += basis[k] * coefficients[k, 1]
        blue += basis[k] * coefficients[k, 2]
    return red, green, blue


@kernel
@no_type_check
def _view_colors(start, stop, means, coefficients, center, radii, colors, degree):
    basis, used = np.empty(16), (degree + 1) ** 2
    for g in range(start, stop):
        red, green, blue = 0.0, 0.0, 0.0
        if radii[g, 0] > 0 and radii[g, 1] > 0:
            x, y, z, _ = _direction(means[g], center)
            _basis(degree, x, y, z, basis)
            red, green, blue = _color(basis, used, coefficients[g])
        colors[g, 0], colors[g, 1], colors[g, 2] = max(red, 0.0), max(green, 0.0), max(blue, 0.0)


@kernel
@no_type_check
def _view_colors_backward(
    start, stop, means, coefficients, center, radii, v_colors, v_means, v_coefficients, v_center, degree
):
    """Adds to `v_means` and `v_coefficients`; writes this chunk's sum of the gradients of mean - center."""
    basis, v_basis, used = np.empty(16), np.empty(16), (degree + 1) ** 2
    sum_x, sum_y, sum_z = 0.0, 0.0, 0.0
    for g in range(start, stop):
        if radii[g, 0] == 0 or radii[g, 1] == 0:
            continue
        if v_colors[g, 0] == 0.0 and v_colors[g, 1] == 0.0 and v_colors[g, 2] == 0.0:
            continue  # in view, but hidden
        x, y, z, distance = _direction(means[g], center)
        _basis(degree, x, y, z, basis)
        red, green, blue = _color(basis, used, coefficients[g])
        v_red = float(v_colors[g, 0]) if red >= 0.0 else 0.0  # a black point's color is exactly 0, and can increase
        v_green = float(v_colors[g, 1]) if green >= 0.0 else 0.0
        v_blue = float(v_colors[g, 2]) if blue >= 0.0 else 0.0
        for k in range(used):
            c = coefficients[g, k]
            v_basis[k] = v_red * c[0] + v_green * c[1] + v_blue * c[2]
            v_coefficients[g, k, 0] += basis[k] * v_red
            v_coefficients[g, k, 1] += basis[k] * v_green
            v_coefficients[g, k, 2] += basis[k] * v_blue
        v_x, v_y, v_z = _basis_backward(degree, x, y, z, v_basis)
        along = v_x * x + v_y * y + v_z * z
        v_x, v_y, v_z = (v_x - along * x) / distance, (v_y - along * y) / distance, (v_z - along * z) / distance
        v_means[g, 0] += v_x
        v_means[g, 1] += v_y
        v_means[g, 2] += v_z
        sum_x += v_x
        sum_y += v_y
        sum_z += v_z
    v_center[start // CHUNK, 0], v_center[start // CHUNK, 1], v_center[start // CHUNK, 2] = sum_x, sum_y, sum_z
