"""Compositing of an image over a cube map."""

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import triton_support


class CubeMap(NamedTuple):
    """`texels` (n, 3) are logits of colors; `index` (face, v, u) is the row of every face's texels in them."""

    texels: Float[Tensor, "n 3"]
    index: Int[Tensor, "6 r r"]


def over_cube_map(
    image: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w 1"],
    cube: CubeMap,
    K: Float[Tensor, "3 3"],
    camera_to_world: Float[Tensor, "4 4"],
    rays: Callable[[], Float[Tensor, "h w 3"]],
    turning: Float[Tensor, "6"] | None = None,
) -> Float[Tensor, "h w 3"]:
    """`image`, premultiplied by `alpha`, over the cube map that a pinhole camera sees (OpenCV axes, K in pixels).

    `rays` returns the world directions of the pixels' centres; it is called where no kernel computes them. A camera
    with rolling shutter is `turning`: a, b, c and its angular velocity (3,) about its own axes, which at the pixel (x,
    y) has lasted for a x + b y + c seconds. Gradients reach the image, alpha and texels, and the camera through `rays`.
    """
    learned = camera_to_world.requires_grad
    if not learned and triton_support.usable_for(image):
        from drivesplat.kernels.triton.cube_map import TritonOverCubeMap as OverCubeMap
    elif not learned and image.device.type == "cpu":
        from drivesplat.kernels.numba.cube_map import NumbaOverCubeMap as OverCubeMap
    else:
        return image + (1.0 - alpha) * cube_map_colors(cube, rays())
    return OverCubeMap.apply(image, alpha, *cube, K, camera_to_world, turning)


def cube_map_colors(cube: CubeMap, rays: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """RGB in [0, 1] along world directions of any length, interpolated bilinearly on a face."""
    return torch.sigmoid(sampled(cube.texels, cube.index, rays))


def sampled(
    texels: Float[Tensor, "n c"], index: Int[Tensor, "6 r r"], rays: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w c"]:
    """Values of texels along world directions of any length, interpolated bilinearly on a face."""
    values = F.grid_sample(
        texels[index].permute(3, 0, 1, 2)[None],
        face_coordinates(rays)[None, None],
        align_corners=True,
        padding_mode="border",
    )
    return values[0, :, 0].permute(1, 2, 0)


def face_coordinates(rays: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Where directions meet the cube, as grid_sample's x, y (on the face) and z (which face), all in [-1, 1].

    Faces 0 to 5 are +x, -x, +y, -y, +z, -z. On a face with axis i, x and y are the coordinates of axes i + 1 and i + 2.
    """
    if rays.device.type == "cpu" and not rays.requires_grad:
        from drivesplat.kernels.numba import cube_map

        return torch.from_numpy(cube_map.face_coordinates(rays.contiguous().numpy()))
    axis = rays.abs().argmax(dim=-1, keepdim=True)
    along = rays.gather(-1, axis)
    u = rays.gather(-1, (axis + 1) % 3) / along.abs()
    v = rays.gather(-1, (axis + 2) % 3) / along.abs()
    face = 2 * axis + (along < 0)
    return torch.cat([u, v, face * (2.0 / 5.0) - 1.0], dim=-1)
