"""An image over a cube map in one pass, and its gradient in another; intersections of directions with a cube."""

from typing import Any, no_type_check

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.cache import callee, fast_callee, kernel
from drivesplat.kernels.numba.fast_exp import fast_exp
from drivesplat.kernels.numba.projection import arrays
from drivesplat.kernels.numba.threads import parallel_for

ROWS = 16
"""Rows of an image per chunk."""
NO_TURNING = torch.zeros(6)
MIN_TRANSMITTANCE = 1e-3
"""Minimum transmittance for gradients of texels: every opaque surface lets a trace of the background through."""


class NumbaOverCubeMap(torch.autograd.Function):
    """`drivesplat.kernels.cube_map.over_cube_map`, without gradient for the camera."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, alpha: Tensor, texels: Tensor, index: Tensor, K: Tensor, camera_to_world: Tensor,
        turning: Tensor | None,
    ) -> Tensor:  # fmt: skip
        blended = torch.empty_like(image, memory_format=torch.contiguous_format)
        turning = NO_TURNING if turning is None else turning
        (focal_x, _, center_x), (_, focal_y, center_y), _ = K.tolist()
        lens = np.array([center_x, center_y, 1.0 / focal_x, 1.0 / focal_y])
        seen = *arrays(alpha[..., 0], texels, index), lens, *arrays(camera_to_world[:3, :3].double(), turning.double())
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
    shrink = 1.0 / abs(along)
    return 2 * axis + (along < 0), u * shrink, v * shrink


@callee
@no_type_check
def _corners(row, column, index, lens, rotation, turning):
    """The four texels around the point that a pixel sees, and the offsets from the first one along both edges of the
    face."""
    x, y = column + 0.5, row + 0.5
    seconds = turning[0] * x + turning[1] * y + turning[2]
    x, y = (x - lens[0]) * lens[2], (y - lens[1]) * lens[3]
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
    a, b = index[face, low_v, low_u], index[face, low_v, high_u]  # not by rows: views of arrays take time
    return a, b, index[face, high_v, low_u], index[face, high_v, high_u], u - low_u, v - low_v


@callee
@no_type_check
def _weights(u, v, real):
    """The weights of the four texels in `real` numbers, in the order of `_corners`."""
    return real((1.0 - u) * (1.0 - v)), real(u * (1.0 - v)), real((1.0 - u) * v), real(u * v)


@fast_callee
@no_type_check
def _to_colors(logits):
    """Replaces the logits (n,) by colours in [0, 1]; NaN stays NaN."""
    real = logits.dtype.type
    one, far = real(1.0), real(25.0)
    for p in range(np.uint64(len(logits))):
        x = logits[p]
        near = abs(x) if abs(x) < far else far
        decay = fast_exp(-near)
        color = (one if x > real(0.0) else decay) / (one + decay)
        logits[p] = color if x == x else x


@kernel
@no_type_check
def _blend(start, stop, image, alpha, texels, index, lens, rotation, turning, sky, blended):
    """Writes the colours of the cube map and those blended in rows `start` to `stop` of an image."""
    real = texels.dtype.type
    for row in range(start, stop):
        for column in range(image.shape[1]):
            a, b, c, d, u, v = _corners(row, column, index, lens, rotation, turning)
            of_a, of_b, of_c, of_d = _weights(u, v, real)
            for k in range(3):
                logit = of_a * texels[a, k] + of_b * texels[b, k] + of_c * texels[c, k] + of_d * texels[d, k]
                sky[row, column, k] = logit
        _to_colors(sky[row].reshape(-1))
        for column in range(image.shape[1]):
            left = real(1.0) - alpha[row, column]
            for k in range(3):
                blended[row, column, k] = image[row, column, k] + left * sky[row, column, k]


@kernel
@no_type_check
def _texels_backward(v_image, sky, alpha, index, lens, rotation, turning, v_texels):
    """Adds up the gradients of texels, pixel after pixel."""
    real = v_texels.dtype.type
    one = real(1.0)
    for row in range(v_image.shape[0]):
        for column in range(v_image.shape[1]):
            left = one - alpha[row, column]
            if left <= MIN_TRANSMITTANCE:
                continue
            a, b, c, d, u, v = _corners(row, column, index, lens, rotation, turning)
            of_a, of_b, of_c, of_d = _weights(u, v, real)
            for k in range(3):
                color = sky[row, column, k]
                by_logit = v_image[row, column, k] * left * color * (one - color)
                v_texels[a, k] += by_logit * of_a
                v_texels[b, k] += by_logit * of_b
                v_texels[c, k] += by_logit * of_c
                v_texels[d, k] += by_logit * of_d


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
