"""What comes of the stage `refine_poses`, and whether it has to: without pycolmap poses stay as they are."""

import logging

from drivesplat.errors import DatasetError, DriveSplatError
from drivesplat.poses.refinement_record import Refinement, verdict
from drivesplat.poses.triangulated import no_points
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.scene import Scene
from drivesplat.settings.refine_poses import RefinePosesJob

log = logging.getLogger(__name__)

UNKNOWN = ("images", "points", "observations", "points_per_image", "reprojection_px", "trial", "shift_m", "turn_deg")
"""What poses.json knows of a refinement, and not of one that was never tried."""


def refined_or_kept(scene: Scene, job: RefinePosesJob, ego_mask: EgoMask = NO_EGO_MASK, threads: int = 1) -> Refinement:
    """`drivesplat.poses.refine.refine_poses`. Where that is not insisted on (`enabled: auto`, from recorded poses), a
    scene that it cannot refine keeps its poses, with a warning, and so does any where pycolmap cannot be imported.

    Raises DriveSplatError where it is insisted on: without pycolmap, and what `refine_poses` raises.
    """
    insisted = job.refine_poses.enabled is True or job.refine_poses.start == "images"
    try:
        from drivesplat.poses.refine import refine_poses  # imports pycolmap
    except ImportError as error:
        reason = f"pycolmap or pyceres cannot be imported ({error})"
        if insisted:
            raise DriveSplatError(
                f"scene {scene.name}: poses cannot be refined: {reason}; install them (envs/drivesplat.yaml has the "
                "versions), or set refine_poses: {enabled: false}"
            ) from error
        return _kept(scene, job, reason)
    try:
        return refine_poses(scene, job, ego_mask, threads)
    except DatasetError as error:
        if insisted:
            raise
        return _kept(scene, job, str(error))


def _kept(scene: Scene, job: RefinePosesJob, reason: str) -> Refinement:
    """A scene as it was, of whose refinement nothing is known."""
    log.warning("scene %s: poses stay as they are: %s", scene.name, reason)
    unknown = dict.fromkeys(UNKNOWN)
    return Refinement(scene, {**verdict(scene, job, reason), **unknown, "corrections": []}, no_points())
