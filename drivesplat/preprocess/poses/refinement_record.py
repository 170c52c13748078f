"""The result of a refinement of poses: the scene, poses.json and triangulated points."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.preprocess.poses.triangulated import TriangulatedPoints
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import RefinePosesJob

SCHEMA = 1


@dataclass(frozen=True)
class Refinement:
    """`scene` with refined or unchanged poses; `record`, the content of poses.json; `points`, of triangulated.npz."""

    scene: Scene
    record: dict[str, Any]
    points: TriangulatedPoints


def record_header(scene: Scene, job: RefinePosesJob, reason: str | None) -> dict[str, Any]:
    """The first keys of poses.json of a refinement with images. `reason`: why the given poses are kept, None where they
    are not."""
    return {
        "schema": SCHEMA,
        "scene": scene.name,
        "start": job.refine_poses.start,
        "refined": reason is None,
        "kept_because": reason,
        "images_kept_because": reason,
        "lidar": None,
    }


def finite(value: float) -> float | None:
    """A value of poses.json: None for one that is not finite."""
    return value if np.isfinite(value) else None
