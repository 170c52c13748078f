"""The stage `refine_poses`, with a fallback to the given poses where refinement is optional and impossible."""

import logging

from drivesplat.errors import DatasetError, DriveSplatError
from drivesplat.poses.refinement_record import Refinement, record_header
from drivesplat.poses.triangulated import no_points
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import RefinePosesJob

log = logging.getLogger(__name__)

MEASURED = (
    "images",
    "points",
    "observations",
    "points_per_image",
    "reprojection_px",
    "trial",
    "shift_m",
    "turn_deg",
    "lens_warnings",
)
"""Keys of poses.json that are null without an attempt."""


def refine_or_keep(scene: Scene, job: RefinePosesJob, ego_mask: EgoMask = NO_EGO_MASK, threads: int = 1) -> Refinement:
    """`drivesplat.poses.refine.refine_poses`. With `enabled: auto` and recorded poses, a scene that it cannot refine
    keeps its poses with a warning, also where pycolmap cannot be imported.

    Raises DriveSplatError otherwise: without pycolmap, and the errors of `refine_poses`.
    """
    required = job.refine_poses.enabled is True or job.refine_poses.start == "images"
    try:
        from drivesplat.poses.refine import refine_poses  # imports pycolmap
    except ImportError as error:
        reason = f"pycolmap or pyceres cannot be imported ({error})"
        if required:
            raise DriveSplatError(
                f"scene {scene.name}: poses cannot be refined: {reason}; install them (envs/drivesplat.yaml has the "
                "versions), or set refine_poses: {enabled: false}"
            ) from error
    else:
        try:
            return refine_poses(scene, job, ego_mask, threads)
        except DatasetError as error:
            if required:
                raise
            reason = str(error)
    log.warning("scene %s: poses stay as they are: %s", scene.name, reason)
    record = {**record_header(scene, job, reason), **dict.fromkeys(MEASURED), "corrections": []}
    return Refinement(scene, record, no_points())
