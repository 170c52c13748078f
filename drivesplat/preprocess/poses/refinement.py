"""The stage `refine_poses`: LiDAR first, then images, with a fallback to the given poses where images are optional and
cannot refine them."""

import logging
from dataclasses import replace

from drivesplat.errors import DatasetError, DriveSplatError
from drivesplat.preprocess.poses.from_sweeps import Alignment, align_sweeps
from drivesplat.preprocess.poses.refinement_record import Refinement, finite, record_header
from drivesplat.preprocess.poses.triangulated import no_points
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
    "judged",
    "cameras_alone_because",
    "shift_m",
    "turn_deg",
    "lens_warnings",
)
"""Keys of poses.json that are null without an attempt."""


def refine_or_keep(scene: Scene, job: RefinePosesJob, ego_mask: EgoMask = NO_EGO_MASK, threads: int = 1) -> Refinement:
    """Registers LiDAR sweeps to each other (`from_sweeps`), then refines the poses with the images (`refine`). With
    `enabled: auto` and recorded poses, a scene whose images cannot refine them keeps them with a warning, also where
    pycolmap cannot be imported.

    Raises DriveSplatError otherwise: without pycolmap, and the errors of `refine_poses`.
    """
    aligned = Alignment(scene, None, None)
    if job.refine_poses.start == "recorded" and job.lidar is not None:
        aligned = align_sweeps(scene, job, threads)
    refinement = _with_images(aligned, job, ego_mask, threads)
    if aligned.record is None or aligned.judge is None:
        return refinement
    record, by_images = refinement.record, refinement.record["images_kept_because"]
    refined = record["refined"] or aligned.record["taken"]
    decision = {
        "refined": refined,
        "kept_because": None if refined else by_images or "registered sweeps fit each other no better",
        "lidar": aligned.record | {"final_m": finite(aligned.judge.distance(refinement.scene))},
    }
    return replace(refinement, record=record | decision)


def _with_images(aligned: Alignment, job: RefinePosesJob, ego_mask: EgoMask, threads: int) -> Refinement:
    """The refinement of aligned poses with the images, or without: then the aligned ones."""
    scene = aligned.scene
    if not scene.frames:
        record = {**record_header(scene, job, None), "refined": False, **dict.fromkeys(MEASURED), "corrections": []}
        return Refinement(scene, record, no_points())
    required = job.refine_poses.enabled is True or job.refine_poses.start == "images"
    try:
        from drivesplat.preprocess.poses.refine import refine_poses  # imports pycolmap
    except ImportError as error:
        reason = f"pycolmap or pyceres cannot be imported ({error})"
        if required:
            raise DriveSplatError(
                f"scene {scene.name}: poses cannot be refined: {reason}; install them (envs/drivesplat.yaml has the "
                "versions), or set refine_poses: {enabled: false}"
            ) from error
    else:
        try:
            return refine_poses(scene, job, ego_mask, threads, aligned.judge)
        except DatasetError as error:
            if required:
                raise
            reason = str(error)
    log.warning("scene %s: poses stay as they are: %s", scene.name, reason)
    record = {**record_header(scene, job, reason), **dict.fromkeys(MEASURED), "corrections": []}
    return Refinement(scene, record, no_points())
