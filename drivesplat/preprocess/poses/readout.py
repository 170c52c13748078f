"""Features of images with a rolling shutter, moved to where they are at the image's timestamp.

Triangulation and adjustment know one pose per image. A feature's own line is read at another time; how far the image
has moved until then depends on the turning of the camera, and on the feature's depth. Depths come from the points of
the last triangulation; features without a point count as far away.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float

from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.recorded_shutters import shutters
from drivesplat.scene.shutter import Shutter, displaced

FAR = 1e4
"""Depth in metres of features without a point."""
STEPS = 3
"""Iterations to find where a feature is at the timestamp; each reduces the error by the ratio of its speed over the
image to that of the readout."""


@dataclass(frozen=True)
class RollingFeatures:
    """Of the images with a rolling shutter, by their number: the features as recorded, in continuous pixels, and the
    shutter."""

    images: RigImages
    recorded: dict[int, tuple[Float[np.ndarray, "_ 2"], Shutter]]

    @classmethod
    def of(cls, images: RigImages, start: pycolmap.Reconstruction) -> "RollingFeatures":
        """Those of a reconstruction whose features are as recorded. Velocities are those of the images' poses."""
        recorded = {
            number: (np.array([f.xy for f in start.images[number].points2D]).reshape(-1, 2), shutter)
            for number, shutter in enumerate(shutters(images.scene, images.frames), start=1)
            if shutter is not None
        }
        return cls(images, recorded)

    def move_to_timestamp(self, reconstruction: pycolmap.Reconstruction) -> None:
        """Moves the features of a reconstruction of these images, in place."""
        for number, (pixels, shutter) in self.recorded.items():
            frame = self.images.frames[number - 1]
            image, size = reconstruction.images[number], (frame.width, frame.height)
            world_to_camera, depths = image.cam_from_world().matrix(), np.full(len(pixels), FAR)
            for i, feature in enumerate(image.points2D):
                if feature.has_point3D():
                    point = reconstruction.points3D[feature.point3D_id].xyz
                    depths[i] = world_to_camera[2, :3] @ point + world_to_camera[2, 3]
            moved = at_timestamp(pixels, depths, shutter, continuous_intrinsics(frame, size), size)
            for feature, xy in zip(image.points2D, moved, strict=True):
                feature.xy = xy


def at_timestamp(
    pixels: Float[np.ndarray, "n 2"],
    depths: Float[np.ndarray, " n"],
    shutter: Shutter,
    intrinsics: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
) -> Float[np.ndarray, "n 2"]:
    """Where resting points, seen at `pixels` and of `depths` (metres), would be seen without rolling shutter. Pixels
    and `intrinsics` are continuous, of an image of `size` (width, height)."""
    to_rays, moved = np.linalg.inv(intrinsics).T, pixels
    for _ in range(STEPS):
        points = depths[:, None] * (np.column_stack([moved, np.ones(len(moved))]) @ to_rays)
        seen = displaced(points, shutter.readout_s, shutter.motion, intrinsics, size) @ intrinsics.T
        moved = pixels - (seen[:, :2] / seen[:, 2:] - moved)
    return moved
