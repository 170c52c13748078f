"""The stage `remove_actor`: a vehicle taken out of a trained model, and what that leaves, in pictures and figures."""

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt
from skimage.color import rgb2gray
from skimage.filters import sobel

from drivesplat.evaluation.metrics import psnr_record
from drivesplat.inspection.ghosts import COVERING, ghosts_of
from drivesplat.inspection.rendered_view import Drive, Sight, colors_of
from drivesplat.inspection.subject import Subject, choose_subject, described
from drivesplat.model.removal import Removal, removal_of
from drivesplat.scene.regions import fill
from drivesplat.settings.inspection import RemovalJob

log = logging.getLogger(__name__)

SCHEMA = 1
CHANGED = 8 / 255
"""A pixel has changed where any channel differs by more."""
HOLE = 0.5
"""A pixel is a hole where the opacity fell below this from above it."""
EDGE_BAND = 2.0
"""Half the width (pixels) of the band along the hull in which an edge is looked for."""


@dataclass(frozen=True)
class RemovalPair:
    """One view with and without the vehicle: images (h, w, 3) in [0, 1], opacities (h, w), `footprint` (h, w) bool the
    pixels that the removed Gaussians reach, `inside` and `outside` those of the box and the others, without the own
    car's body; `outline` (n, 2) of the box in continuous pixels, empty without a vehicle."""

    with_car: np.ndarray
    without_car: np.ndarray
    alpha_with: np.ndarray
    alpha_without: np.ndarray
    footprint: np.ndarray
    inside: np.ndarray
    outside: np.ndarray
    outline: np.ndarray


def remove_actor(drive: Drive, job: RemovalJob) -> tuple[RemovalPair, dict[str, Any]]:
    """The pair of pictures and the content of removal.json, provenance aside.

    Where no vehicle moves before the camera, both pictures are the middle key frame's and the figures are None, with
    the reason.
    """
    subject = choose_subject(drive.recording, job.eval_camera, job.subject)
    if subject is None:
        return _nothing_to_remove(drive, job)
    sight = Sight(drive, subject.index)
    removal = removal_of(drive.model, sight.gaussians, subject.box, job.removal.margin)
    pair = _pair(sight, subject, removal)
    count = int(removal.removed.sum())
    log.info("%s: %d Gaussians removed by %s", drive.recording.scene.name, count, removal.by)
    if removal.by == "box":
        log.info(
            "what the box held is gone; the vehicle's shadow, and its ghosts along its way, stay. A learned "
            "decomposition (Street Gaussians, the method 'street') gives the vehicle Gaussians of its own: leaving "
            "these out shows the background behind it as other images saw it"
        )
    return pair, {
        "schema": SCHEMA,
        "scene": drive.recording.scene.name,
        "key_frame": sight.frame.sample_index,
        "subject": described(subject, drive.recording),
        "why_null": None,
        "removed_by": removal.by,
        "margin_m": job.removal.margin,
        "gaussians_removed": count,
        **figures(pair),
        "ghosts": _ghost_figures(sight, subject, pair, job),
    }


def _pair(sight: Sight, subject: Subject, removal: Removal) -> RemovalPair:
    before, after, alone = sight.of(), sight.of(~removal.removed), sight.of(removal.removed)
    hull, seen = fill(subject.hull.polygon, sight.size), ~sight.drive.recording.own_car(sight.index)
    return RemovalPair(
        with_car=colors_of(before.image),
        without_car=colors_of(after.image),
        alpha_with=colors_of(before.alpha),
        alpha_without=colors_of(after.alpha),
        footprint=colors_of(alone.alpha) > 0.0,
        inside=hull & seen,
        outside=~hull & seen,
        outline=subject.hull.polygon,
    )


def figures(pair: RemovalPair) -> dict[str, Any]:
    """What the removal changed: nothing here is a gate, all of it is to be known.

    `box`: pixels of the hull, the share that changed, and how much of what they show is the sky behind all Gaussians,
    where a learned sky may have kept the vehicle. `holes`: pixels of the image that lost their surface, and the share
    of the box that did. `edge`: mean gradient of the luminance along the hull, with and without. `outside`: PSNR
    between both pictures off the hull, the share that changed there and how far (pixels) from the hull the change
    reaches. `outside_footprint`: the same PSNR where no removed Gaussian reaches, which is to be infinite.
    """
    changed = (np.abs(pair.with_car - pair.without_car) > CHANGED).any(axis=2)
    holes = (pair.alpha_without < HOLE) & (pair.alpha_with >= HOLE)
    distance = distance_transform_edt(~pair.inside)
    leaked = distance[pair.outside & changed]
    return {
        "box": {
            "pixels": int(pair.inside.sum()),
            "changed_share": _share(changed, pair.inside),
            "sky_share_with": _mean(1.0 - pair.alpha_with, pair.inside),
            "sky_share_without": _mean(1.0 - pair.alpha_without, pair.inside),
        },
        "holes": {"pixels": int(holes.sum()), "share_of_box": _share(holes, pair.inside)},
        "edge": _edge(pair, distance),
        "outside": {
            **(psnr_record(pair.without_car, pair.with_car, pair.outside) or {"psnr": None, "pixels": 0}),
            "changed_share": _share(changed, pair.outside),
            "reach_px": float(leaked.max()) if len(leaked) else 0.0,
        },
        "outside_footprint": psnr_record(pair.without_car, pair.with_car, ~pair.footprint),
    }


def _edge(pair: RemovalPair, distance_outside: np.ndarray) -> dict[str, float | None]:
    """The mean gradient along the hull in both pictures, and their ratio: above 1, the removal draws an outline.

    None where the hull has no edge in the image. Where the own car cuts the hull is no edge.
    """
    nothing = {"with_car": None, "without_car": None, "ratio": None}
    if pair.inside.all() or not pair.inside.any():
        return nothing
    seen = pair.inside | pair.outside
    clear = seen if seen.all() else distance_transform_edt(seen) > EDGE_BAND + 1.0
    band = clear & (distance_outside <= EDGE_BAND) & (distance_transform_edt(pair.inside) <= EDGE_BAND)
    if not band.any():
        return nothing
    before, after = (float(sobel(rgb2gray(image))[band].mean()) for image in (pair.with_car, pair.without_car))
    return {"with_car": before, "without_car": after, "ratio": after / before if before > 0 else None}


def _ghost_figures(sight: Sight, subject: Subject, pair: RemovalPair, job: RemovalJob) -> dict[str, Any]:
    """The ghosts that stay, and whether they are seen outside the box."""
    ghosts = ghosts_of(sight, subject.box, job.ghosts)
    opacity = colors_of(sight.of(ghosts.rows).alpha)
    covered = (opacity >= COVERING) & pair.outside
    return {
        **ghosts.figures(sight.gaussians),
        "covered_share_outside": _share(covered, pair.outside),
        "reach_outside_box": bool(covered.any()),
    }


def _nothing_to_remove(drive: Drive, job: RemovalJob) -> tuple[RemovalPair, dict[str, Any]]:
    sight = Sight(drive, drive.recording.scene.middle_key_frame(job.eval_camera))
    picture = sight.of()
    image, alpha = colors_of(picture.image), colors_of(picture.alpha)
    nowhere = np.zeros(alpha.shape, dtype=bool)
    nulls = ("subject", "removed_by", "box", "holes", "edge", "outside", "outside_footprint", "ghosts")
    reason = f"no vehicle moves before {job.eval_camera} in this scene"
    log.warning("%s: nothing to remove: %s", drive.recording.scene.name, reason)
    return RemovalPair(image, image, alpha, alpha, nowhere, nowhere, ~nowhere, np.zeros((0, 2))), {
        "schema": SCHEMA,
        "scene": drive.recording.scene.name,
        "key_frame": sight.frame.sample_index,
        "why_null": reason,
        "margin_m": job.removal.margin,
        "gaussians_removed": 0,
        **dict.fromkeys(nulls),
    }


def _mean(values: np.ndarray, among: np.ndarray) -> float | None:
    """The mean of values over a mask; None for an empty one."""
    return float(values[among].mean()) if among.any() else None


def _share(chosen: np.ndarray, among: np.ndarray) -> float | None:
    """How much of a mask another one holds; None for an empty mask."""
    return _mean(chosen, among)
