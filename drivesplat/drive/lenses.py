"""Images of distorted cameras, resampled from pinhole images that together cover what the lens sees."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from drivesplat.drive.cameras import PoseableCamera
from drivesplat.model.view import View
from drivesplat.scene.lens import central_intrinsics, pixels_of, radial_profile
from drivesplat.scene.rigid import rigid
from drivesplat.scene.sensors import Camera

STEPS, STEP = 8, 1e-4
"""Iterations of Newton's method for the direction of a pixel, and the step in radians of its differences."""
MAX_ERROR = 0.05
"""Pixels by which the image of a direction may miss its pixel; a farther one has no direction."""
MAX_HALF_ANGLE = np.radians(55.0)
"""Angle to the optical axis up to which one pinhole image serves. Wider lenses take the faces of a cube."""
MARGIN = 2
"""Pixels by which a face reaches over its edge, for the interpolation there."""
FACES = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # ahead
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],  # to the right
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # to the left
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # downwards
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # upwards
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],  # behind
    ],
    dtype=np.float64,
)
"""The rotations (6, 3, 3) from the axes of each face to those of the camera."""


@dataclass(frozen=True)
class Face:
    """A pinhole image of a distorted camera: its `view`, the pixels (h, w) of the distorted image that it shows, where
    they lie in it, `x` and `y` (n,) in continuous pixels, and the ratio (n,) between distance and depth there."""

    view: View
    shows: Bool[Tensor, "h w"]
    x: Tensor
    y: Tensor
    distance_by_depth: Tensor


def directions(camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """The unit direction of every pixel of a distorted camera (x right, y down, z forward); NaN where it has none."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    k = central_intrinsics(camera)
    across = (pixels - camera.intrinsics[:2, 2]) / [1.0, k[1, 1] / k[0, 0]]
    radius = np.linalg.norm(across, axis=1)
    known, radii = radial_profile(camera)
    angles = np.interp(radius, radii, known)
    turn = angles[:, None] * across / np.maximum(radius, 1e-12)[:, None]  # the angle, towards the pixel
    for _ in range(STEPS):
        found = pixels_of(camera, _turned(turn))
        by_x, by_y = (pixels_of(camera, _turned(turn + step)) for step in (np.array([STEP, 0.0]), [0.0, STEP]))
        slopes = np.stack([by_x - found, by_y - found], axis=-1) / STEP
        determinant = np.linalg.det(slopes)
        missing = ~(np.abs(determinant) > 1e-9)
        slopes[missing] = np.eye(2)
        turn = turn + np.where(missing[:, None], 0.0, np.linalg.solve(slopes, (pixels - found)[..., None])[..., 0])
    rays = _turned(turn)
    missed = ~(np.linalg.norm(pixels_of(camera, rays) - pixels, axis=1) < MAX_ERROR)
    rays[missed] = np.nan
    return rays.reshape(camera.height, camera.width, 3)


def _turned(turn: np.ndarray) -> np.ndarray:
    """The optical axis turned by angles (n, 2) in radians towards the right and down."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    return np.hstack([turn * np.sinc(angle / np.pi), np.cos(angle)])


def faces_of(camera: PoseableCamera, view: View) -> list[Face]:
    """The pinhole images that show what a distorted camera sees from a view, at the resolution of its centre."""
    lens = camera.lens
    rays = directions(lens)
    known = np.isfinite(rays).all(axis=-1)
    k = central_intrinsics(lens)
    widest = np.arccos(np.clip(rays[known][:, 2].min(initial=1.0), -1.0, 1.0))
    narrow = widest <= MAX_HALF_ANGLE
    chosen = np.where(known, 0, -1)
    if not narrow:
        along = np.nan_to_num(rays) @ FACES[:, :, 2].T
        chosen = np.where(known, along.argmax(axis=-1), -1)
    return [
        _face(view, FACES[number], rays[chosen == number], chosen == number, k)
        for number in range(1 if narrow else len(FACES))
        if (chosen == number).any()
    ]


def _face(view: View, turn: np.ndarray, rays: np.ndarray, shows: np.ndarray, k: np.ndarray) -> Face:
    own = rays @ turn
    flat = own[:, :2] / own[:, 2:] * k.diagonal()[:2]
    low = np.floor(flat.min(axis=0)) - MARGIN
    width, height = (np.ceil(flat.max(axis=0)) + MARGIN - low).astype(int).tolist()
    K = np.array([[k[0, 0], 0.0, -low[0]], [0.0, k[1, 1], -low[1]], [0.0, 0.0, 1.0]])
    device = view.K.device
    pose = view.camera_to_world.double() @ torch.from_numpy(rigid(turn, np.zeros(3))).to(device)
    pinhole = View(torch.from_numpy(K).float().to(device), pose.float(), width, height, view.time, camera=view.camera)
    x, y = torch.from_numpy(flat - low).float().to(device).unbind(dim=1)
    return Face(pinhole, torch.from_numpy(shows).to(device), x, y, torch.from_numpy(1.0 / own[:, 2]).float().to(device))


def resampled(faces: Sequence[Face], images: Sequence[Tensor], nearest: bool, as_distance: bool = False) -> Tensor:
    """The distorted image (h, w) or (h, w, c) of the images of its faces; 0 where the lens has no direction. Values of
    the `nearest` pixel, as numbers and depths need, or bilinear ones; depths may become distances."""
    found = images[0].new_zeros((*faces[0].shows.shape, *images[0].shape[2:]))
    for face, image in zip(faces, images, strict=True):
        if nearest:
            values = image[face.y.long(), face.x.long()]
        else:
            size = torch.tensor([face.view.width, face.view.height], device=image.device)
            grid = torch.stack([face.x, face.y], dim=-1) / size * 2.0 - 1.0
            channels = image.reshape(face.view.height, face.view.width, -1).movedim(-1, 0)[None]
            sampled = torch.nn.functional.grid_sample(channels, grid[None, None], align_corners=False)
            values = sampled[0, :, 0].T.reshape(-1, *image.shape[2:])
        found[face.shows] = values * face.distance_by_depth if as_distance else values
    return found
