"""An image over a cube map in one pass, and its gradient in another; intersections of directions with a cube."""

import math
from typing import Any, no_type_check

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.cache import callee, kernel
from drivesplat.kernels.numba.projection import arrays
from drivesplat.kernels.numba.threads import parallel_for

ROWS = 16
"""Rows of an image per chunk."""
NO_TURNING = torch.zeros(6)
MIN_TRANSMITTANCE = 1e-3
"""Minimum transmittance for gradients of texels: every opaque surface lets a trace of the background through."""


class OverCubeMap(torch.autograd.Function):
    """`drivesplat.kernels.cube_map.over_cube_map`, without gradient for the camera."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, alpha: Tensor, texels: Tensor, index: Tensor, K: Tensor, camera_to_world: Tensor,
        turning: Tensor | None,
    ) -> Tensor:  # fmt: skip
        blended = torch.empty_like(image, memory_format=torch.contiguous_format)
        turning = NO_TURNING if turning is None else turning
        camera = arrays(K.double(), camera_to_world[:3, :3].double(), turning.double())
        seen = *arrays(alpha[..., 0], texels, index), *camera
        sky = torch.empty_like(blended)
        parallel_for(_blend, len(image), ROWS, *arrays(image), *seen, *arrays(sky, blended))
        ctx.save_for_backward(sky)
        ctx.seen = seen
        return blended

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor) -> tuple[Tensor | None, ...]:
        (sky,) = ctx.saved_tensors
        alpha, texels, *camera = ctx.seen
        v_texels = np.zeros_like(texels)
        _texels_backward(*arrays(v_image, sky), alpha, *camera, v_texels)
        v_alpha = -torch.linalg.vecdot(v_image, sky)[..., None]
        return v_image, v_alpha, torch.from_numpy(v_texels), None, None, None, None


def face_coordinates(rays: np.ndarray) -> np.ndarray:
    """`drivesplat.kernels.cube_map.face_coordinates` of directions (h, w, 3), in one pass."""
    coordinates = np.empty_like(rays)
    parallel_for(_face_coordinates, len(rays), ROWS, rays, coordinates)
    return coordinates


@callee
@no_type_check
def _on_face(x, y, z):
    """The face that a direction meets, and the coordinates in [-1, 1] where it does."""
    far_x, far_y, far_z = abs(x), abs(y), abs(z)
    if far_x >= far_y and far_x >= far_z:
        axis, along, u, v = 0, x, y, z
    elif far_y >= far_z:
        axis, along, u, v = 1, y, z, x
    else:
        axis, along, u, v = 2, z, x, y
    return 2 * axis + (along < 0), u / abs(along), v / abs(along)


@callee
@no_type_check
def _corners(row, column, index, K, rotation, turning):
    """The four texels around the point that a pixel sees, and the offsets from the first one along both edges of the
    face."""
    x, y = column + 0.5, row + 0.5
    seconds = turning[0] * x + turning[1] * y + turning[2]
    x, y = (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]
    by_x, by_y, by_z = turning[3], turning[4], turning[5]
    x, y, z = x + seconds * (by_y - by_z * y), y + seconds * (by_z * x - by_x), 1.0 + seconds * (by_x * y - by_y * x)
    face, u, v = _on_face(
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )
    last = index.shape[1] - 1
    u, v = min(max((u + 1.0) * 0.5 * last, 0.0), last), min(max((v + 1.0) * 0.5 * last, 0.0), last)
    low_u, low_v = int(u), int(v)
    high_u, high_v = min(low_u + 1, last), min(low_v + 1, last)
    above, below = index[face, low_v], index[face, high_v]
    return above[low_u], above[high_u], below[low_u], below[high_u], u - low_u, v - low_v


@callee
@no_type_check
def _color(texels, channel, corners):
    """One channel of the cube map's colour, interpolated."""
    a, b, c, d, u, v = corners
    above = (1.0 - u) * texels[a, channel] + u * texels[b, channel]
    below = (1.0 - u) * texels[c, channel] + u * texels[d, channel]
    return 1.0 / (1.0 + math.exp(-((1.0 - v) * above + v * below)))


@kernel
@no_type_check
def _blend(start, stop, image, alpha, texels, index, K, rotation, turning, sky, blended):
    """Writes the colours of the cube map and those blended in rows `start` to `stop` of an image."""
    for row in range(start, stop):
        for column in range(image.shape[1]):
            corners = _corners(row, column, index, K, rotation, turning)
            left = 1.0 - alpha[row, column]
            for channel in range(3):
                color = _color(texels, channel, corners)
                sky[row, column, channel] = color
                blended[row, column, channel] = image[row, column, channel] + left * color


@kernel
@no_type_check
def _texels_backward(v_image, sky, alpha, index, K, rotation, turning, v_texels):
    """Adds up the gradients of texels, pixel after pixel."""
    for row in range(v_image.shape[0]):
        for column in range(v_image.shape[1]):
            left = 1.0 - alpha[row, column]
            if left <= MIN_TRANSMITTANCE:
                continue
            a, b, c, d, u, v = _corners(row, column, index, K, rotation, turning)
            for channel in range(3):
                color = sky[row, column, channel]
                by_logit = v_image[row, column, channel] * left * color * (1.0 - color)
                v_texels[a, channel] += by_logit * (1.0 - u) * (1.0 - v)
                v_texels[b, channel] += by_logit * u * (1.0 - v)
                v_texels[c, channel] += by_logit * (1.0 - u) * v
                v_texels[d, channel] += by_logit * u * v


@kernel
@no_type_check
def _face_coordinates(start, stop, rays, coordinates):
    """Processes rows `start` to `stop` of directions."""
    for row in range(start, stop):
        for column in range(rays.shape[1]):
            face, u, v = _on_face(rays[row, column, 0], rays[row, column, 1], rays[row, column, 2])
            coordinates[row, column, 0] = u
            coordinates[row, column, 1] = v
            coordinates[row, column, 2] = face * (2.0 / 5.0) - 1.0
