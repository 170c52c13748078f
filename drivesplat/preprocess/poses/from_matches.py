"""Matches over longer baselines than a refinement uses, as a judge of corrections.

Their errors depend on poses alone: a match in another image lies on a line that two poses and the feature determine.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pycolmap
from jaxtyping import Float

from drivesplat.preprocess.poses.features import later_images, match_pairs
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import cross_matrix, inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.refine_poses import RefinePosesJob

MAX_PAIRS = 60
"""Pairs of images that judge; of more, evenly spread ones."""
MIN_MATCHES = 100
"""Matches without which there is no judgement."""


@dataclass(frozen=True)
class MatchJudge:
    """Matched features, in homogeneous continuous pixels (n, 3), of pairs of frames by their indices in
    `Scene.frames`."""

    pairs: list[tuple[int, int, Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]]
    name: ClassVar[str] = "matches_px"

    def distance(self, scene: Scene) -> float:
        """The median Sampson distance in pixels of matches to the epipolar geometry of the poses (Hartley, Zisserman:
        Multiple View Geometry, 11.4.3)."""
        errors = []
        for i, j, first, second in self.pairs:
            matrix = _fundamental(scene.frames[i], scene.frames[j])
            lines, back = first @ matrix.T, second @ matrix
            scale = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
            errors.append(np.abs(np.einsum("ni,ni->n", second, lines)) / scale)
        return float(np.median(np.concatenate(errors)))

    def objection(self, before: float, after: float) -> str | None:
        """What speaks against refined poses, by their distance and that of the given ones; None if it is not larger."""
        if after <= before:
            return None
        return f"the error of withheld matches is {after:.2f} pixels with them and {before:.2f} with the given ones"


def match_judge(images: RigImages, job: RefinePosesJob, database: Path, threads: int) -> MatchJudge | None:
    """Matches images whose features `database` has, beyond the pairs that are matched there; None without enough."""
    pairs = withheld_pairs(images, job)
    if not pairs:
        return None
    copy = database.with_name("withheld.db")
    shutil.copyfile(database, copy)
    match_pairs([(i + 1, j + 1) for i, j in pairs], job, copy, threads)
    found = []
    with pycolmap.Database.open(copy) as features:
        for i, j in pairs:
            matches = features.read_two_view_geometry(i + 1, j + 1).inlier_matches
            first, second = (_pixels(features, k)[matches[:, side]] for side, k in enumerate((i + 1, j + 1)))
            found.append((images.indices[i], images.indices[j], first, second))
    return MatchJudge(found) if sum(len(first) for _, _, first, _ in found) >= MIN_MATCHES else None


def withheld_pairs(images: RigImages, job: RefinePosesJob) -> list[tuple[int, int]]:
    """Pairs of indices of images of one camera that are a neighbour farther apart than those that are matched."""
    settings = job.refine_poses.features
    beyond = settings.model_copy(update={"neighbours": settings.neighbours + 1})
    pairs = []
    for by_key_frame in images.key_frames().values():
        ordered = [by_key_frame[key] - 1 for key in sorted(by_key_frame)]
        for i, later in enumerate(later_images(images.ego_to_world[ordered], beyond)):
            if len(later) == beyond.neighbours:
                pairs.append((ordered[i], ordered[later[-1]]))
    return [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, MAX_PAIRS).astype(int))] if pairs else []


def _pixels(features: pycolmap.Database, number: int) -> np.ndarray:
    """The keypoints (n, 3) of an image, homogeneous."""
    keypoints = np.asarray(features.read_keypoints(number), dtype=np.float64)[:, :2]
    return np.column_stack([keypoints, np.ones(len(keypoints))])


def _fundamental(first: Frame, second: Frame) -> np.ndarray:
    """The matrix (3, 3) from pixels of the first image to lines in the second."""
    relative = inverse(second.camera_to_world) @ first.camera_to_world
    own, other = (np.linalg.inv(continuous_intrinsics(frame, (frame.width, frame.height))) for frame in (first, second))
    return other.T @ cross_matrix(relative[:3, 3]) @ relative[:3, :3] @ own
