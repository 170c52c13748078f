"""The stage `remove_actor`: a trained model with and without a vehicle, as images and figures."""

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt
from skimage.color import rgb2gray
from skimage.filters import sobel

from drivesplat.evaluation.metrics import psnr_record
from drivesplat.model.removal import Removal, removal_of
from drivesplat.scene.regions import fill
from drivesplat.settings.visuals import RemovalJob
from drivesplat.visuals.ghosts import MIN_COVERING_OPACITY, ghost_figures, ghosts_of
from drivesplat.visuals.rendered_view import ModelWithRecording, RenderedView, colors_of
from drivesplat.visuals.subject import Subject, choose_subject, no_subject_reason, subject_record

log = logging.getLogger(__name__)

SCHEMA = 1
CHANGE_THRESHOLD = 8 / 255
"""A pixel has changed if any channel differs by more."""
HOLE_OPACITY = 0.5
"""A pixel is a hole if its opacity has fallen below this value."""
EDGE_BAND = 2.0
"""Half the width (pixels) of the band along the hull in which gradients are measured."""


@dataclass(frozen=True)
class RemovalPair:
    """A view with and without the vehicle: images (h, w, 3) in [0, 1] and opacities (h, w); masks (h, w) bool:
    `footprint` of the pixels that the removed Gaussians reach, `inside` and `outside` of the box, both without the ego
    mask; `outline` (n, 2) of the box in continuous pixels, empty without a vehicle."""

    with_car: np.ndarray
    without_car: np.ndarray
    alpha_with: np.ndarray
    alpha_without: np.ndarray
    footprint: np.ndarray
    inside: np.ndarray
    outside: np.ndarray
    outline: np.ndarray


def remove_actor(drive: ModelWithRecording, job: RemovalJob) -> tuple[RemovalPair, dict[str, Any]]:
    """The pair of images and the content of removal.json without provenance.

    If no moving vehicle is visible, both images are those of the middle key frame, and the figures are None, with the
    reason.
    """
    scene, reason = drive.recording.scene, no_subject_reason(job.eval_camera)
    subject = choose_subject(drive.recording, job.eval_camera, job.subject)
    view = RenderedView(drive, subject.index if subject else scene.middle_key_frame(job.eval_camera))
    record = {
        "schema": SCHEMA,
        "scene": scene.name,
        "key_frame": view.frame.sample_index,
        "subject": None,
        "why_null": reason,
        "removed_by": None,
        "margin_m": job.removal.margin,
        "gaussians_removed": 0,
        **dict.fromkeys(("box", "holes", "edge", "outside", "outside_footprint", "ghosts")),
    }
    if subject is None:
        log.warning("%s: nothing to remove: %s", scene.name, reason)
        picture = view.render()
        image, alpha = colors_of(picture.image), colors_of(picture.alpha)
        empty = np.zeros(alpha.shape, dtype=bool)
        return RemovalPair(image, image, alpha, alpha, empty, empty, ~empty, np.zeros((0, 2))), record
    removal = removal_of(drive.model, view.gaussians, subject.box, job.removal.margin)
    pair = _pair(view, subject, removal)
    count = int(removal.removed.sum())
    log.info("%s: %d Gaussians removed by %s", scene.name, count, removal.by)
    if removal.by == "box":
        log.info(
            "the Gaussians in the box are removed; the vehicle's shadow and its ghosts along its path remain. With a "
            "learned decomposition (Street Gaussians, the method 'street') the vehicle has its own Gaussians: without "
            "them the rendering shows the background as other images observed it"
        )
    ghosts = ghosts_of(view, subject.box, job.ghosts)
    covered = (colors_of(view.render(ghosts).alpha) >= MIN_COVERING_OPACITY) & pair.outside
    return pair, record | {
        "subject": subject_record(subject, drive.recording),
        "why_null": None,
        "removed_by": removal.by,
        "gaussians_removed": count,
        **figures(pair),
        "ghosts": {
            **ghost_figures(view.gaussians, ghosts),
            "covered_share_outside": _mean(covered, pair.outside),
            "reach_outside_box": bool(covered.any()),
        },
    }


def _pair(view: RenderedView, subject: Subject, removal: Removal) -> RemovalPair:
    before, after, alone = view.render(), view.render(~removal.removed), view.render(removal.removed)
    hull, visible = fill(subject.hull.polygon, view.size), ~view.drive.recording.ego_mask(view.index)
    return RemovalPair(
        with_car=colors_of(before.image),
        without_car=colors_of(after.image),
        alpha_with=colors_of(before.alpha),
        alpha_without=colors_of(after.alpha),
        footprint=colors_of(alone.alpha) > 0.0,
        inside=hull & visible,
        outside=~hull & visible,
        outline=subject.hull.polygon,
    )


def figures(pair: RemovalPair) -> dict[str, Any]:
    """The changes made by the removal; informative, never a criterion.

    `box`: pixels of the hull, their changed share, and the weight of the sky in them, in which a learned sky may have
    absorbed the vehicle. `holes`: pixels whose opacity has fallen below HOLE_OPACITY, and their share of the box.
    `edge`: mean luminance gradient along the hull, with and without the vehicle. `outside`: PSNR between both images
    outside of the hull, the changed share there, and the maximum distance (pixels) of a change from the hull.
    `outside_footprint`: the same PSNR where no removed Gaussian reaches; infinite if the removal is exact.
    """
    changed = (np.abs(pair.with_car - pair.without_car) > CHANGE_THRESHOLD).any(axis=2)
    holes = (pair.alpha_without < HOLE_OPACITY) & (pair.alpha_with >= HOLE_OPACITY)
    distance = distance_transform_edt(~pair.inside)
    distances = distance[pair.outside & changed]
    return {
        "box": {
            "pixels": int(pair.inside.sum()),
            "changed_share": _mean(changed, pair.inside),
            "sky_share_with": _mean(1.0 - pair.alpha_with, pair.inside),
            "sky_share_without": _mean(1.0 - pair.alpha_without, pair.inside),
        },
        "holes": {"pixels": int(holes.sum()), "share_of_box": _mean(holes, pair.inside)},
        "edge": _edge(pair, distance),
        "outside": {
            **(psnr_record(pair.without_car, pair.with_car, pair.outside) or {"psnr": None, "pixels": 0}),
            "changed_share": _mean(changed, pair.outside),
            "reach_px": float(distances.max()) if len(distances) else 0.0,
        },
        "outside_footprint": psnr_record(pair.without_car, pair.with_car, ~pair.footprint),
    }


def _edge(pair: RemovalPair, distance_outside: np.ndarray) -> dict[str, float | None]:
    """The mean gradient along the hull in both images, and their ratio; above 1 the removal has added an outline.

    None if the hull has no edge in the image. The boundary with the ego mask is not an edge.
    """
    no_edge = {"with_car": None, "without_car": None, "ratio": None}
    if pair.inside.all() or not pair.inside.any():
        return no_edge
    visible = pair.inside | pair.outside
    clear = visible if visible.all() else distance_transform_edt(visible) > EDGE_BAND + 1.0
    band = clear & (distance_outside <= EDGE_BAND) & (distance_transform_edt(pair.inside) <= EDGE_BAND)
    if not band.any():
        return no_edge
    before, after = (float(sobel(rgb2gray(image))[band].mean()) for image in (pair.with_car, pair.without_car))
    return {"with_car": before, "without_car": after, "ratio": after / before if before > 0 else None}


def _mean(values: np.ndarray, mask: np.ndarray) -> float | None:
    """The mean of values over a mask; None if it is empty."""
    return float(values[mask].mean()) if mask.any() else None
