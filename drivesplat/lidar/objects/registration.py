"""How well the returns of two clusters lie on one surface."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from drivesplat.lidar.objects.boxes import Discovered
from drivesplat.lidar.objects.clusters import Chain, Cluster

MAX_POINTS = 100
"""Returns of a cluster that are looked at, evenly chosen."""
FREE = 3.0
"""Factor on the distance of surfaces that were moved until they fit: chance makes it small."""


def misfit(a: Cluster, b: Cluster, shift: Float[np.ndarray, "2"]) -> float:
    """The median distance in metres of the returns of the smaller cluster from those of the larger one, after the
    horizontal `shift` of the first."""
    moved, still = a.points + np.array([*shift, 0.0]), b.points
    few, many = (moved, still) if len(moved) <= len(still) else (still, moved)
    chosen = few[:: -(-len(few) // MAX_POINTS)]
    return float(np.median(cKDTree(many).query(chosen)[0]))


def least_misfit(a: Cluster, b: Cluster) -> float:
    """The least `misfit` (metres) where the low corners, the high corners or the middles of both meet: parts of an
    object may be hidden."""
    corners = [(c.points[:, :2].min(axis=0), c.points[:, :2].max(axis=0), c.place) for c in (a, b)]
    return min(misfit(a, b, to - start) for start, to in zip(*corners, strict=True))


def misfit_along(chain: Chain, item: Discovered) -> float:
    """The median `misfit` (metres) of consecutive clusters of a chain, moved as its box moves; or FREE times that where
    they fit best, since patches of the even side of a long vehicle slide along it."""
    places = item.path.places(chain.seconds)
    pairs = zip(chain.clusters[:-1], chain.clusters[1:], np.diff(places, axis=0), strict=True)
    return float(np.median([min(misfit(a, b, shift), FREE * least_misfit(a, b)) for a, b, shift in pairs]))
