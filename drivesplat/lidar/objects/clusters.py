"""Clusters of moving returns in single scans, and chains: clusters of one object over time."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drivesplat.scene.scan_record import RecordedScan

APART, APART_SHARE = 0.6, 0.01
"""Metres, and fraction of the range, by which returns of one object lie apart horizontally at most."""
MIN_RETURNS = 3
MEMORY_S = 0.5
"""Seconds over which the velocity of a chain is taken."""


@dataclass(frozen=True)
class Cluster:
    """Moving returns of scan number `scan` that lie close together: `points` (n, 3) in world metres, at their mean time
    `seconds` since the first image, seen from `origin` (3,)."""

    scan: int
    seconds: float
    points: Float[np.ndarray, "n 3"]
    origin: Float[np.ndarray, "3"]

    @cached_property
    def place(self) -> Float[np.ndarray, "2"]:
        """The horizontal middle of its extents."""
        return 0.5 * (self.points[:, :2].min(axis=0) + self.points[:, :2].max(axis=0))

    @property
    def lowest(self) -> float:
        """The height of its lowest return in metres."""
        return float(self.points[:, 2].min())


@dataclass
class Chain:
    """Clusters of one object, in order of time."""

    clusters: list[Cluster] = field(default_factory=list)

    @property
    def seconds(self) -> Float[np.ndarray, " k"]:
        return np.array([cluster.seconds for cluster in self.clusters])

    @property
    def places(self) -> Float[np.ndarray, "k 2"]:
        return np.stack([cluster.place for cluster in self.clusters])

    def motion_at(self, end: Literal[0, -1]) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Where it was seen first (0) or last (-1), and its velocity (m/s) then: a line through MEMORY_S seconds there,
        or through the two clusters there."""
        seconds, places, at = self.seconds, self.places, self.clusters[end].seconds
        order = np.argsort(np.abs(seconds - at), kind="stable")
        near = order[: max(2, int((np.abs(seconds - at) <= MEMORY_S).sum()))]
        if len(near) < 2:
            return places[order[0]], np.zeros(2)
        design = np.stack([np.ones(len(near)), seconds[near] - at], axis=1)
        place, velocity = np.linalg.lstsq(design, places[near], rcond=None)[0]
        return place, velocity


def clusters_of(scan: RecordedScan, number: int, moving: Bool[np.ndarray, " n"]) -> list[Cluster]:
    """The clusters of the moving ones of a scan's measured returns."""
    chosen = scan.scan.returned & scan.measured
    points = scan.points()[moving]
    seconds = scan.seconds + scan.scan.rays.offsets_s[chosen][moving].astype(np.float64)
    origin = scan.sensor_to_world[:3, 3]
    if len(points) < MIN_RETURNS:
        return []
    labels = connected(points[:, :2], np.linalg.norm(points - origin, axis=1))
    sizes = np.bincount(labels)
    own = [labels == label for label in np.flatnonzero(sizes >= MIN_RETURNS)]
    return [Cluster(number, float(seconds[rows].mean()), points[rows], origin) for rows in own]


def connected(places: Float[np.ndarray, "n 2"], ranges: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """The number of the connected set of each place, at `ranges` metres from the sensor."""
    reach = APART + APART_SHARE * ranges
    pairs = cKDTree(places).query_pairs(float(reach.max()), output_type="ndarray")
    apart = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    pairs = pairs[apart <= np.minimum(reach[pairs[:, 0]], reach[pairs[:, 1]])]
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(places), len(places)))
    return connected_components(links, directed=False)[1]
