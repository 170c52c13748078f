"""The drivable area beside a recorded path: as wide as the road's surface is known there."""

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int
from scipy.ndimage import maximum_filter1d
from scipy.spatial import cKDTree

from drivesplat.model.height_field import HeightField
from drivesplat.trajectories.reference_path import ReferencePath

STEP, CONTINUED = 0.1, 1000.0
"""Metres between the places of the path at which the road has a width, and by which it is continued straight on."""
ON_PATH = 2.0
"""Metres beside the recorded path that are drivable, since the recorded vehicle drove there."""
REACH = 20.0
"""Metres beside the path up to which the surface counts."""
ALONG = 6.0
"""Metres along the path, before and behind, whose widest place counts: next to the vehicle no sensor sees the road."""


class DrivableStrip:
    """Called with places (k, 2) in world metres, tells which are drivable: those that are no farther to the left or
    right of the nearest place of a recorded path than the road's surface, cut at kerbs, is known there, or than
    ON_PATH. Where nothing is known, as before the first image and after the last, the nearest known width holds."""

    def __init__(self, recorded: ReferencePath, surface: HeightField):
        path, directions = recorded.at(np.arange(0.0, recorded.length + CONTINUED, STEP))
        self._path, self._tree = path, cKDTree(path)
        self._left = np.stack([-directions[:, 1], directions[:, 0]], axis=1)
        cells = surface.covered.nonzero().cpu().numpy() + 0.5
        places = surface.lower.cpu().numpy() + surface.edge * cells
        nearest, aside = self._beside(places)
        away = np.linalg.norm(places - path[nearest], axis=1)
        beside = np.abs(aside) > 0.9 * away  # not before the begin of the path or behind its end
        known = nearest[beside], aside[beside]
        widths = (self._width(*known, side) + 0.5 * surface.edge for side in (1.0, -1.0))
        self._widths = [np.maximum(width, ON_PATH) for width in widths]

    def __call__(self, places: Float64[np.ndarray, "k 2"]) -> Bool[np.ndarray, " k"]:
        nearest, aside = self._beside(places)
        left, right = self._widths
        return (aside <= left[nearest]) & (-aside <= right[nearest])

    def _beside(self, places: Float64[np.ndarray, "k 2"]) -> tuple[np.ndarray, np.ndarray]:
        """The nearest places of the path, and the metres to the left of them."""
        nearest = self._tree.query(places)[1]
        return nearest, ((places - self._path[nearest]) * self._left[nearest]).sum(axis=1)

    def _width(
        self, nearest: Int[np.ndarray, " c"], aside: Float64[np.ndarray, " c"], side: float
    ) -> Float64[np.ndarray, " p"]:
        """The metres to one side up to which the surface is known, at each place of the path, by the cells' nearest
        places and how far they are to the left."""
        width = np.full(len(self._path), -np.inf)
        counts = (side * aside > 0.0) & (side * aside < REACH)
        np.maximum.at(width, nearest[counts], side * aside[counts])
        window = 2 * round(ALONG / STEP) + 1
        width = maximum_filter1d(width, window)
        known = np.flatnonzero(np.isfinite(width))
        if len(known):
            every = np.arange(len(width))
            after = known[np.searchsorted(known, every).clip(max=len(known) - 1)]
            before = known[(np.searchsorted(known, every, side="right") - 1).clip(min=0)]
            nearer = np.where(every - before <= after - every, before, after)
            around = maximum_filter1d(width, window)  # the last known place has few cells
            width = np.where(np.isfinite(width), width, around[nearer])
        return width


def drivable_strip(path: ReferencePath, surface: HeightField | None) -> DrivableStrip | None:
    """The drivable area of a recorded path on a road with this surface; None where no surface is known."""
    return None if surface is None or not bool(torch.any(surface.covered)) else DrivableStrip(path, surface)
