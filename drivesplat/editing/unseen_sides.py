"""Frames of an edited drive that show an object from a side that no training image shows: it has no Gaussians there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivesplat.rendering.film import Shot
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import inverse
from drivesplat.scene.splits import training_images
from drivesplat.trajectories.edited_actors import EditedActor

UNSEEN = "sides that no camera saw"
"""The note in the film."""
MAX_TURN = np.radians(40.0)
"""An object seen from farther round than this from all directions in training shows a side that is not there."""
MIN_SHARE_TRAINED, MIN_SHARE_SHOWN = 0.02, 0.05
"""Height of an object as a share of the image's height from which a training image and a frame count."""


@dataclass(frozen=True)
class _Cameras:
    """Cameras at `seconds` (n,): `camera_to_world` (n, 4, 4), `K` (n, 3, 3) in continuous pixels, `size` (n, 2)."""

    seconds: np.ndarray
    camera_to_world: np.ndarray
    K: np.ndarray
    size: np.ndarray

    def azimuths(self, actor: EditedActor, min_share: float) -> np.ndarray:
        """The direction (n,) of each camera in the frame of the object, radians to the left of its front; NaN where the
        object is absent, its centre outside of the image, or the object smaller than `min_share`."""
        poses = actor.poses(self.seconds)
        beside = (inverse(poses) @ self.camera_to_world[:, :, 3:])[:, :3, 0]
        center = (inverse(self.camera_to_world) @ poses[:, :, 3:])[:, :3, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = (self.K @ (center / center[:, 2:])[..., None])[:, :2, 0]
            height = self.K[:, 1, 1] * actor.size[2] / center[:, 2] / self.size[:, 1]
        shown = (center[:, 2] > 0.0) & (pixels > 0.0).all(axis=1) & (pixels < self.size).all(axis=1)
        shown &= actor.present(self.seconds) & (height >= min_share)
        return np.where(shown, np.arctan2(beside[:, 1], beside[:, 0]), np.nan)


def unseen_sides(recorded: Sequence[EditedActor], edited: Sequence[EditedActor], shot: Shot) -> np.ndarray:
    """The frames (n,) bool of a shot that show one of the `edited` actors from a side that no training image shows;
    `recorded` are the actors before the edit. Objects that hide each other are not accounted for."""
    scene, count = shot.scene, len(shot.cameras)
    frames = [scene.frames[i] for i in training_images(scene, shot.format.holdout)]
    sizes = [(frame.width, frame.height) for frame in frames]
    trained = _Cameras(
        np.array([scene.seconds(frame.timestamp) for frame in frames]),
        np.array([frame.camera_to_world for frame in frames]).reshape(-1, 4, 4),
        np.array([continuous_intrinsics(f, size) for f, size in zip(frames, sizes, strict=True)]).reshape(-1, 3, 3),
        np.array(sizes).reshape(-1, 2),
    )
    repeated = np.tile(shot.K, (count, 1, 1)), np.tile(shot.size, (count, 1))
    filmed = _Cameras(np.array(shot.seconds), shot.cameras.camera_to_world, *repeated)
    known = {actor.id: trained.azimuths(actor, MIN_SHARE_TRAINED) for actor in recorded}
    found = np.zeros(count, dtype=bool)
    for actor in edited:
        azimuths, seen = filmed.azimuths(actor, MIN_SHARE_SHOWN), known[actor.source]
        turns = np.abs(np.angle(np.exp(1j * (azimuths[:, None] - seen[~np.isnan(seen)]))))
        found |= ~np.isnan(azimuths) & (turns.min(axis=1, initial=np.pi) > MAX_TURN)
    return found
