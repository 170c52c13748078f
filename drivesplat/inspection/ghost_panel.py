"""The stage `ghost_panel`: a moving vehicle as it was, as a model shows it, where that fails, and what it leaves."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.evaluation.metrics import psnr_record
from drivesplat.inspection.ghosts import COVERING, STEP, boxes_along, ghosts_of
from drivesplat.inspection.rendered_view import Drive, Sight, colors_of
from drivesplat.inspection.subject import Subject, choose_subject, described
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.regions import region_mask
from drivesplat.scene.rigid import inverse
from drivesplat.settings.inspection import GhostSettings, PanelJob

SCHEMA = 1
DIMMED = 0.3
LARGEST_STRENGTH = 4.0
"""Ghosts are drawn at most so many times more opaque than they are: they are faint, and they are to be seen."""
WELL_SEEN = 0.9
"""The opacity at which nearly all of them should stay below."""
IN_FRONT = 0.5


@dataclass(frozen=True)
class Panel:
    """What is drawn: pictures (h, w, 3) in [0, 1], `haunted` the dimmed image under the strengthened ghosts; and in
    continuous pixels the `outline` (n, 2) of the box and the `way` (m, 2) of its centre over the ground, both empty
    where nothing moves."""

    truth: np.ndarray
    render: np.ndarray
    haunted: np.ndarray
    outline: np.ndarray
    way: np.ndarray


def ghost_panel(drive: Drive, job: PanelJob) -> tuple[Panel, dict[str, Any]]:
    """What is drawn, and the content of ghost_panel.json, provenance aside.

    Where no vehicle moves before the camera the middle key frame is shown, and the figures of the vehicle and its
    ghosts are None, with the reason.
    """
    recording = drive.recording
    subject = choose_subject(recording, job.eval_camera, job.subject)
    sight = Sight(drive, subject.index if subject else recording.scene.middle_key_frame(job.eval_camera))
    truth, render = recording.image(sight.index), colors_of(sight.of().image)
    static = region_mask(recording.labels(sight.index), "static")
    record = {
        "schema": SCHEMA,
        "scene": recording.scene.name,
        "key_frame": sight.frame.sample_index,
        "subject": described(subject, recording) if subject else None,
        "static": psnr_record(render, truth, static),
        "vehicle": psnr_record(render, truth, subject.visible) if subject else None,
        "ghosts": None,
        "why_null": None if subject else f"no vehicle moves before {job.eval_camera} in this scene",
    }
    dimmed = DIMMED * np.repeat(truth.mean(axis=2, keepdims=True), 3, axis=2)
    if subject is None:
        return Panel(truth, render, dimmed, np.zeros((0, 2)), np.zeros((0, 2))), record
    haunted, record["ghosts"] = _haunting(sight, subject, dimmed, job.ghosts)
    return Panel(truth, render, haunted, subject.hull.polygon, _way(sight, subject)), record


def _haunting(
    sight: Sight, subject: Subject, dimmed: np.ndarray, settings: GhostSettings
) -> tuple[np.ndarray, dict[str, Any]]:
    """The ghosts in their own colours over the `dimmed` image (h, w, 3), strengthened to be seen, and their figures."""
    ghosts = ghosts_of(sight, subject.box, settings)
    alone = sight.of(ghosts.rows)
    opacity = colors_of(alone.alpha)
    covered = opacity >= COVERING
    strength = 1.0
    if covered.any():
        strength = float(np.clip(WELL_SEEN / np.quantile(opacity[covered], 0.95), 1.0, LARGEST_STRENGTH))
    own_color = colors_of(alone.splats) / np.maximum(opacity, 1e-6)[..., None]
    shown = np.minimum(strength * opacity, 1.0)[..., None]
    haunted = shown * own_color.clip(0.0, 1.0) + (1.0 - shown) * dimmed
    figures = {"covered_share": float(covered.mean()), "drawn_times": strength}
    return haunted, {**ghosts.figures(sight.gaussians), **figures}


def _way(sight: Sight, subject: Subject) -> np.ndarray:
    """Where the vehicle's way over the ground lies in the image: (m, 2) continuous pixels, NaN behind the camera and
    where the annotation has a gap."""
    scene = sight.drive.recording.scene
    boxes = boxes_along(scene.track(subject.box.track_id), scene.key_frame_interval)
    ground = np.array([box.object_to_world[:3, 3] - box.object_to_world[:3, 2] * box.size[2] / 2 for box in boxes])
    pixels, depth = project(
        ground, inverse(sight.frame.camera_to_world), continuous_intrinsics(sight.frame, sight.size)
    )
    pixels[depth <= IN_FRONT] = np.nan
    gaps = np.flatnonzero(np.linalg.norm(np.diff(ground, axis=0), axis=1) > 2 * STEP)
    return np.insert(pixels, gaps + 1, np.nan, axis=0)
