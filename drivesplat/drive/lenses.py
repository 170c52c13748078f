"""Images of distorted cameras, resampled from pinhole images that together cover what the lens sees."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from drivesplat.model.view import View
from drivesplat.scene.lens import central_intrinsics, directions
from drivesplat.scene.rigid import rigid
from drivesplat.scene.sensors import Camera

MAX_HALF_ANGLE = np.radians(55.0)
"""Angle to the optical axis up to which one pinhole image serves. Wider lenses take the faces of a cube."""
MARGIN = 2
"""Pixels by which a face reaches over its edge, for the interpolation there."""
TURNS = np.array(
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
"""The rotations (6, 3, 3) from the axes of each face of a cube to those of the camera."""


@dataclass(frozen=True, eq=False)
class LensFace:
    """A pinhole image that a distorted image is resampled from: the rotation `turn` from its axes to those of the
    camera, its `K` and size in pixels. The pixels of the distorted image that it `shows` lie at `places` (x, y), in
    continuous pixels; `distance_by_depth` is the ratio between distance and depth there."""

    turn: Float64[np.ndarray, "3 3"]
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int
    shows: Bool[Tensor, "h w"]
    places: Float[Tensor, "n 2"]
    distance_by_depth: Float[Tensor, " n"]

    def view(self, camera: View) -> View:
        """The view of this image from the place of a camera."""
        device = camera.K.device
        pose = camera.camera_to_world.double() @ torch.from_numpy(rigid(self.turn, np.zeros(3))).to(device)
        K = torch.from_numpy(self.K).float().to(device)
        return replace(camera, K=K, camera_to_world=pose.float(), width=self.width, height=self.height)

    def sampled(self, image: Tensor, nearest: bool, as_distance: bool) -> Tensor:
        """The values (n,) or (n, c) of its image (h, w) or (h, w, c) at its places."""
        places = self.places.to(image.device)
        if nearest:
            x, y = places.long().unbind(dim=1)
            values = image[y, x]
        else:
            size = torch.tensor([self.width, self.height], device=image.device)
            channels = image.reshape(self.height, self.width, -1).movedim(-1, 0)[None]
            grid = (places / size * 2.0 - 1.0)[None, None]
            found = torch.nn.functional.grid_sample(channels, grid, align_corners=False)
            values = found[0, :, 0].T.reshape(-1, *image.shape[2:])
        return values * self.distance_by_depth.to(image.device) if as_distance else values


def faces_of(lens: Camera) -> list[LensFace]:
    """The pinhole images that show what a distorted camera sees, at the resolution of its centre; none where its lens
    images no direction within its image."""
    rays, k = directions(lens), central_intrinsics(lens)
    known = np.isfinite(rays).all(axis=-1)
    if not known.any():
        return []
    widest = np.arccos(np.clip(rays[known][:, 2].min(initial=1.0), -1.0, 1.0))
    if widest <= MAX_HALF_ANGLE:
        return [_face(TURNS[0], rays, known, k)]
    nearest = np.where(known, (np.nan_to_num(rays) @ TURNS[:, :, 2].T).argmax(axis=-1), -1)
    return [_face(TURNS[i], rays, nearest == i, k) for i in range(len(TURNS)) if (nearest == i).any()]


def _face(turn: np.ndarray, rays: np.ndarray, shows: np.ndarray, k: np.ndarray) -> LensFace:
    """The face with this rotation that shows some pixels of a camera."""
    own = rays[shows] @ turn
    flat = own[:, :2] / own[:, 2:] * k.diagonal()[:2]
    low = np.floor(flat.min(axis=0)) - MARGIN
    width, height = (np.ceil(flat.max(axis=0)) + MARGIN - low).astype(int).tolist()
    K = np.array([[k[0, 0], 0.0, -low[0]], [0.0, k[1, 1], -low[1]], [0.0, 0.0, 1.0]])
    tensors = (torch.from_numpy(values) for values in (shows, (flat - low).astype(np.float32)))
    return LensFace(turn, K, width, height, *tensors, torch.from_numpy((1.0 / own[:, 2]).astype(np.float32)))


def resampled(faces: Sequence[LensFace], images: Sequence[Tensor], nearest: bool, as_distance: bool = False) -> Tensor:
    """The distorted image (h, w) or (h, w, c) of the images of its faces; 0 where the lens has no direction. Values of
    the `nearest` pixel, as numbers and depths need, or bilinear ones; depths may become distances."""
    found = images[0].new_zeros((*faces[0].shows.shape, *images[0].shape[2:]))
    for face, image in zip(faces, images, strict=True):
        found[face.shows.to(found.device)] = face.sampled(image, nearest, as_distance)
    return found
