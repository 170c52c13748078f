"""Moving objects of a drive from its LiDAR scans: evidence, clusters, chains, boxes."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from drivesplat.discovery.boxes import Discovered, fitted_box
from drivesplat.discovery.clusters import Chain, chains_of, clusters_of
from drivesplat.discovery.merging import merged, united
from drivesplat.discovery.seen_empty import seen_empty
from drivesplat.scene.scan_record import RecordedScan

MIN_SCANS, MIN_SECONDS, MIN_WAY = 3, 0.4, 1.0
"""Scans, seconds and metres of a chain that is an object."""
MIN_FILL = 0.35
"""Fraction of the scans between its first and its last one in which it was found."""
MIN_TYPICAL = 4.0
"""Median number of returns of its clusters."""
STRAIGHT = 0.5
"""Least ratio of the distance between its ends to the length of its way."""
MAX_CLEARANCE = 0.8
"""Metres between the ground and the lowest return of an object."""
AROUND, LOWEST = 3.0, 5.0
"""Metres around an object in which the lowest returns, by percentile, are the ground."""


def discovered(scans: Sequence[RecordedScan]) -> list[Discovered]:
    """The moving objects in the scans of one LiDAR, in order of the time at which they appear."""
    ordered = sorted(scans, key=lambda scan: scan.timestamp)
    moving = seen_empty(ordered)
    clusters = [clusters_of(scan, k, own) for k, (scan, own) in enumerate(zip(ordered, moving, strict=True))]
    grounds = Grounds(ordered, moving)
    chains = [chain for chain in merged(_long(chains_of(clusters))) if is_object(chain) and grounds.carries(chain)]
    return sorted(_without_overlaps(chains, grounds), key=lambda it: it.seconds[0])


def _without_overlaps(chains: Sequence[Chain], grounds: "Grounds") -> list[Discovered]:
    """The boxes of chains; chains whose boxes overlap while both move are one object."""
    boxes = [(chain, fitted_box(chain, grounds.below(chain))) for chain in chains]
    while True:
        pairs = ((i, j) for i, j in combinations(range(len(boxes)), 2) if overlap(boxes[i][1], boxes[j][1]))
        pair = next(pairs, None)
        if pair is None:
            return [box for _, box in boxes]
        whole = united(*(boxes[k][0] for k in pair))
        boxes = [it for k, it in enumerate(boxes) if k not in pair]
        boxes.append((whole, fitted_box(whole, grounds.below(whole))))


def overlap(a: Discovered, b: Discovered) -> bool:
    """Whether the centre of each box mostly lies in the other one, over their common time."""
    first, last = max(a.seconds[0], b.seconds[0]), min(a.seconds[-1], b.seconds[-1])
    if last <= first:
        return False
    seconds = np.linspace(first, last, 10)
    inside = []
    for outer, inner in ((a, b), (b, a)):
        poses, places = outer.poses(seconds), inner.poses(seconds)[:, :3, 3]
        local = np.einsum("nji,nj->ni", poses[:, :3, :3], places - poses[:, :3, 3])
        inside.append((np.abs(local[:, :2]) < 0.5 * outer.size[:2]).all(axis=1).mean())
    return min(inside) > 0.5


def _long(chains: Sequence[Chain]) -> list[Chain]:
    return [chain for chain in chains if len(chain.clusters) >= MIN_SCANS]


def is_object(chain: Chain) -> bool:
    """Whether a chain is long, dense and straight enough to be an object that moves."""
    seconds, places = chain.seconds, chain.places
    scans = chain.clusters[-1].scan - chain.clusters[0].scan + 1
    count = max(2, round((seconds[-1] - seconds[0]) / 0.5) + 1)
    coarse = np.stack([np.interp(np.linspace(*seconds[[0, -1]], count), seconds, places[:, k]) for k in (0, 1)], axis=1)
    way = np.linalg.norm(np.diff(coarse, axis=0), axis=1).sum()
    distance = np.linalg.norm(places[-1] - places[0])
    return bool(
        len(seconds) >= MIN_SCANS
        and seconds[-1] - seconds[0] >= MIN_SECONDS
        and distance >= MIN_WAY
        and distance >= STRAIGHT * way
        and len(seconds) >= MIN_FILL * scans
        and np.median([len(cluster.points) for cluster in chain.clusters]) >= MIN_TYPICAL
    )


class Grounds:
    """The heights of the ground by the scans' returns that do not move."""

    def __init__(self, scans: Sequence[RecordedScan], moving: Sequence[Bool[np.ndarray, " n"]]):
        self._scans, self._moving = scans, moving
        self._trees: dict[int, tuple[cKDTree, np.ndarray]] = {}

    def below(self, chain: Chain) -> Float[np.ndarray, " k"]:
        """The height of the ground below each cluster of a chain in metres."""
        found = np.array([self._below(cluster.scan, cluster.place) for cluster in chain.clusters])
        lowest = np.array([cluster.points[:, 2].min() for cluster in chain.clusters])
        found = np.where(np.isfinite(found), found, lowest)
        return np.minimum(found, lowest)

    def carries(self, chain: Chain) -> bool:
        """Whether a chain mostly reaches down to the ground, as objects that move do, and leaves and signs do not."""
        places = [(cluster.scan, cluster.place) for cluster in chain.clusters]
        heights = [c.points[:, 2].min() - self._below(*at) for c, at in zip(chain.clusters, places, strict=True)]
        return bool(np.nanmedian(heights) < MAX_CLEARANCE) if np.isfinite(heights).any() else False

    def _below(self, number: int, place: np.ndarray) -> float:
        if number not in self._trees:
            points = self._scans[number].points()[~self._moving[number]]
            self._trees[number] = cKDTree(points[:, :2]), points[:, 2]
        tree, heights = self._trees[number]
        near = tree.query_ball_point(place, AROUND)
        return float(np.percentile(heights[near], LOWEST)) if len(near) >= 5 else float("nan")
