"""What comes of a refinement of poses: the scene, poses.json and triangulated points."""

from dataclasses import dataclass
from typing import Any

from drivesplat.poses.triangulated import TriangulatedPoints
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import RefinePosesJob

SCHEMA = 1


@dataclass(frozen=True)
class Refinement:
    """`scene`: with refined poses, or as it was; `record`: the content of poses.json; `points`: of triangulated.npz."""

    scene: Scene
    record: dict[str, Any]
    points: TriangulatedPoints


def verdict(scene: Scene, job: RefinePosesJob, fault: str | None) -> dict[str, Any]:
    """The head of poses.json; `fault` says why poses stay as they are, None where they do not."""
    start = job.refine_poses.start
    return {"schema": SCHEMA, "scene": scene.name, "start": start, "refined": fault is None, "kept_because": fault}
