"""Images of distorted cameras, resampled from pinhole images that together cover what the lens sees."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from drivesplat.model.view import RollingShutter, View, turned_motion
from drivesplat.scene.lens import central_intrinsics, directions
from drivesplat.scene.rigid import rigid
from drivesplat.scene.sensors import Camera

MAX_HALF_ANGLE = np.radians(55.0)
"""Angle to the optical axis up to which one pinhole image serves. Wider lenses take the faces of a cube."""
BANDS = 16
"""Parts in which an image with a rolling shutter is resampled, each as it is at the time of its middle."""
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
    continuous pixels; `distance_by_depth` is the ratio between distance and depth there. With a rolling shutter it is
    read at `middle`: x and y in fractions of the distorted image's width and height from its centre."""

    turn: Float64[np.ndarray, "3 3"]
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int
    shows: Bool[Tensor, "h w"]
    places: Float[Tensor, "n 2"]
    distance_by_depth: Float[Tensor, " n"]
    middle: tuple[float, float] = (0.0, 0.0)

    def view(self, camera: View) -> View:
        """The view of this image from the place of a camera."""
        device = camera.K.device
        pose = camera.camera_to_world.double() @ torch.from_numpy(rigid(self.turn, np.zeros(3))).to(device)
        K, shutter = torch.from_numpy(self.K).float().to(device), camera.shutter
        if shutter is not None:
            shutter = RollingShutter(self._readout(shutter.readout_s), turned_motion(shutter.motion, self.turn))
        return replace(camera, K=K, camera_to_world=pose.float(), width=self.width, height=self.height, shutter=shutter)

    def _readout(self, readout_s: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
        """The readout of this image, all of which is read at the time of its middle."""
        along = readout_s.new_tensor(self.middle)
        return torch.cat([torch.zeros_like(along), (readout_s[:2] @ along + readout_s[2])[None]])

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


def faces_of(lens: Camera, max_angle: float | None = None, bands: tuple[int, int] = (1, 1)) -> list[LensFace]:
    """The pinhole images that show what a distorted camera sees, at the resolution of its centre; none where its lens
    images no direction within its image. Directions farther than `max_angle` from the optical axis are not imaged.
    Images of their own show each of `bands`, columns and rows into which the distorted image is cut."""
    rays, k = directions(lens), central_intrinsics(lens)
    known = np.isfinite(rays).all(axis=-1)
    if max_angle is not None:
        known &= np.nan_to_num(rays)[..., 2] >= np.cos(max_angle)
    if not known.any():
        return []
    faces = []
    for band, middle in _cut(known.shape, bands):
        faces += [replace(face, middle=middle) for face in _faces(rays, known & band, k)]
    return faces


def _cut(
    size: tuple[int, int], bands: tuple[int, int]
) -> Iterator[tuple[Bool[np.ndarray, "h w"], tuple[float, float]]]:
    """The pixels of each band of an image (height, width), and the place of its middle as in `LensFace`."""
    rows, columns = (np.array_split(np.arange(length), n) for length, n in zip(size, reversed(bands), strict=True))
    for own_rows, own_columns in itertools.product(rows, columns):
        if len(own_rows) and len(own_columns):
            band = np.zeros(size, dtype=bool)
            band[np.ix_(own_rows, own_columns)] = True
            x, y = (
                float(own.mean() + 0.5) / length - 0.5
                for own, length in zip((own_columns, own_rows), reversed(size), strict=True)
            )
            yield band, (x, y)


def _faces(
    rays: Float64[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], k: Float[np.ndarray, "3 3"]
) -> list[LensFace]:
    """The pinhole images that show the `known` pixels of a camera."""
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
