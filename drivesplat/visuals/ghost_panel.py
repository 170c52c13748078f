"""The stage `ghost_panel`: ground truth and rendering of a moving vehicle, the error, and the ghosts along its path."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.evaluation.metrics import psnr_record
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.regions import region_mask
from drivesplat.scene.rigid import inverse
from drivesplat.settings.visuals import PanelJob
from drivesplat.visuals.ghosts import (
    MIN_COVERING_OPACITY,
    SAMPLE_DISTANCE,
    boxes_along_path,
    ghost_figures,
    ghosts_of,
)
from drivesplat.visuals.rendered_view import ModelWithRecording, RenderedView, colors_of
from drivesplat.visuals.subject import Subject, choose_subject, no_subject_reason, subject_record

SCHEMA = 1
PALE = (0.45, 0.95)
"""The greys of the image behind ghosts: of black, and of its 98th percentile. Ghosts are red on it, day or night."""
GHOST_COLOR = (0.85, 0.05, 0.1)
MAX_AMPLIFICATION = 10.0
"""Maximum factor by which the opacity of ghosts is amplified to make them visible."""
TARGET_OPACITY = 0.9
"""The amplified opacity of the 95th percentile."""
MIN_DEPTH = 0.5
"""Metres; points of the path nearer to the camera, or behind it, are not drawn."""


@dataclass(frozen=True)
class GhostPanel:
    """Images (h, w, 3) in [0, 1], `ghosts` being the pale image under the amplified ghosts; and in continuous pixels
    the `outline` (n, 2) of the box and the `path` (m, 2) of its centre on the ground, both empty without a moving
    vehicle."""

    truth: np.ndarray
    render: np.ndarray
    ghosts: np.ndarray
    outline: np.ndarray
    path: np.ndarray


def ghost_panel(drive: ModelWithRecording, job: PanelJob) -> tuple[GhostPanel, dict[str, Any]]:
    """The panel, and the content of ghost_panel.json without provenance.

    If no moving vehicle is visible, the panel shows the middle key frame, and the figures of vehicle and ghosts are
    None, with the reason.
    """
    recording = drive.recording
    subject = choose_subject(recording, job.eval_camera, job.subject)
    view = RenderedView(drive, subject.index if subject else recording.scene.middle_key_frame(job.eval_camera))
    truth, render = recording.image(view.index), colors_of(view.render().image)
    static = region_mask(recording.labels(view.index), "static")
    record = {
        "schema": SCHEMA,
        "scene": recording.scene.name,
        "key_frame": view.frame.sample_index,
        "subject": subject_record(subject, recording) if subject else None,
        "static": psnr_record(render, truth, static),
        "vehicle": psnr_record(render, truth, subject.visible) if subject else None,
        "ghosts": None,
        "why_null": None if subject else no_subject_reason(job.eval_camera),
    }
    grey = truth.mean(axis=2, keepdims=True)
    bright = max(float(np.quantile(grey, 0.98)), 1e-3)
    pale = np.repeat(PALE[0] + (PALE[1] - PALE[0]) * np.minimum(grey / bright, 1.0), 3, axis=2)
    if subject is None:
        return GhostPanel(truth, render, pale, np.zeros((0, 2)), np.zeros((0, 2))), record
    ghosts = ghosts_of(view, subject.box, job.ghosts)
    opacity = colors_of(view.render(ghosts).alpha)
    covered = opacity >= MIN_COVERING_OPACITY
    amplification = 1.0
    if covered.any():
        amplification = float(np.clip(TARGET_OPACITY / np.quantile(opacity[covered], 0.95), 1.0, MAX_AMPLIFICATION))
    weight = np.minimum(amplification * opacity, 1.0)[..., None]
    shown = weight * np.array(GHOST_COLOR) + (1.0 - weight) * pale
    figures = {"covered_share": float(covered.mean()), "drawn_times": amplification}
    record["ghosts"] = {**ghost_figures(view.gaussians, ghosts), **figures}
    return GhostPanel(truth, render, shown, subject.hull.polygon, _ground_path(view, subject)), record


def _ground_path(view: RenderedView, subject: Subject) -> np.ndarray:
    """The vehicle's path on the ground in the image: (m, 2) continuous pixels, NaN behind the camera and in gaps of the
    annotation."""
    scene = view.drive.recording.scene
    boxes = boxes_along_path(scene.track(subject.box.track_id), scene.key_frame_interval)
    ground = np.array([box.object_to_world[:3, 3] - box.object_to_world[:3, 2] * box.size[2] / 2 for box in boxes])
    pixels, depth = project(ground, inverse(view.frame.camera_to_world), continuous_intrinsics(view.frame, view.size))
    pixels[depth <= MIN_DEPTH] = np.nan
    gaps = np.flatnonzero(np.linalg.norm(np.diff(ground, axis=0), axis=1) > 2 * SAMPLE_DISTANCE)
    return np.insert(pixels, gaps + 1, np.nan, axis=0)
