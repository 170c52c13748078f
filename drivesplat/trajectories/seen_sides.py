"""The sides of an object that cameras see."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import training_images
from drivesplat.settings.images import HoldoutSettings
from drivesplat.trajectories.edited_actors import EditedActor

MIN_SHARE_TRAINED = 0.02
"""Height of an object as a share of the image's height from which a training image shows its sides."""


@dataclass(frozen=True)
class TimedCameras:
    """Cameras at `seconds` (n,): `camera_to_world` (n, 4, 4), `K` (n, 3, 3) in continuous pixels, `size` (n, 2)."""

    seconds: Float[np.ndarray, " n"]
    camera_to_world: Float[np.ndarray, "n 4 4"]
    K: Float[np.ndarray, "n 3 3"]
    size: np.ndarray

    @classmethod
    def of_training(cls, scene: Scene, holdout: HoldoutSettings) -> "TimedCameras":
        """Those of the training images of a scene."""
        frames = [scene.frames[i] for i in training_images(scene, holdout)]
        sizes = [(frame.width, frame.height) for frame in frames]
        return cls(
            np.array([scene.seconds(frame.timestamp) for frame in frames]),
            np.array([frame.camera_to_world for frame in frames]).reshape(-1, 4, 4),
            np.array([continuous_intrinsics(f, size) for f, size in zip(frames, sizes, strict=True)]).reshape(-1, 3, 3),
            np.array(sizes).reshape(-1, 2),
        )

    def shares(self, actor: EditedActor) -> Float[np.ndarray, " n"]:
        """The height (n,) of an object as a share of each image's height; 0 where it is absent, or its centre outside
        of the image. Objects that hide each other are not accounted for."""
        center = (inverse(self.camera_to_world) @ actor.poses(self.seconds)[:, :, 3:])[:, :3, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = (self.K @ (center / center[:, 2:])[..., None])[:, :2, 0]
            height = self.K[:, 1, 1] * actor.size[2] / center[:, 2] / self.size[:, 1]
        shown = (center[:, 2] > 0.0) & (pixels > 0.0).all(axis=1) & (pixels < self.size).all(axis=1)
        return np.where(shown & actor.present(self.seconds), height, 0.0)

    def azimuths(self, actor: EditedActor, min_share: float = MIN_SHARE_TRAINED) -> Float[np.ndarray, " n"]:
        """The direction (n,) of each camera in the frame of the object, radians to the left of its front; NaN where its
        share of the image is below `min_share`."""
        beside = (inverse(actor.poses(self.seconds)) @ self.camera_to_world[:, :, 3:])[:, :3, 0]
        return np.where(self.shares(actor) >= min_share, np.arctan2(beside[:, 1], beside[:, 0]), np.nan)
