"""Frames of an edited drive that show an object from a side that no training image shows: it has no Gaussians there."""

from collections.abc import Sequence

import numpy as np

from drivesplat.rendering.film import Shot
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.seen_sides import TimedCameras

UNSEEN = "sides that no camera saw"
"""The note in the film."""
MAX_TURN = np.radians(40.0)
"""An object seen from farther round than this from all directions in training shows a side that is not there."""
MIN_SHARE_SHOWN = 0.05
"""Height of an object as a share of the frame's height from which a frame counts."""


def unseen_sides(recorded: Sequence[EditedActor], edited: Sequence[EditedActor], shot: Shot) -> np.ndarray:
    """The frames (n,) bool of a shot that show one of the `edited` actors from a side that no training image shows;
    `recorded` are the actors before the edit, and assets that it inserts have `seen`. Objects that hide each other are
    not accounted for."""
    trained, count = TimedCameras.of_training(shot.scene, shot.format.holdout), len(shot.cameras)
    repeated = np.tile(shot.K, (count, 1, 1)), np.tile(shot.size, (count, 1))
    filmed = TimedCameras(np.array(shot.seconds), shot.cameras.camera_to_world, *repeated)
    known = {actor.id: trained.azimuths(actor) for actor in recorded}
    found = np.zeros(count, dtype=bool)
    for actor in edited:
        azimuths = filmed.azimuths(actor, MIN_SHARE_SHOWN)
        seen = known[actor.source] if actor.seen is None else actor.seen
        turns = np.abs(np.angle(np.exp(1j * (azimuths[:, None] - seen[~np.isnan(seen)]))))
        found |= ~np.isnan(azimuths) & (turns.min(axis=1, initial=np.pi) > MAX_TURN)
    return found
