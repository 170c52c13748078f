"""Objects that come near each other: returns of one cluster that belong to two of them.

A cluster of returns that lie close together holds both while two objects pass each other. Its middle belongs to
neither, and its extents make the box of either too large.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from drivesplat.discovery.boxes import Discovered
from drivesplat.discovery.clusters import MIN_RETURNS, Chain, Cluster

REACH = 0.5
"""Metres beyond a box in which returns may belong to its object."""


def separated(chains: Sequence[Chain], boxes: Sequence[Discovered]) -> list[Chain]:
    """The chains with each return of their clusters in the chain to whose box it is nearest at the cluster's time.

    `boxes` are those of the chains. Returns that no other box reaches stay where they are. Clusters with fewer than
    MIN_RETURNS returns left are dropped.
    """
    clusters: dict[int, list[tuple[int, Cluster]]] = {}
    for number, chain in enumerate(chains):
        for cluster in chain.clusters:
            clusters.setdefault(cluster.scan, []).append((number, cluster))
    made = [Chain() for _ in chains]
    for scan in sorted(clusters):
        for number, cluster in _of_scan(clusters[scan], boxes):
            made[number].clusters.append(cluster)
    return made


def _of_scan(owned: Sequence[tuple[int, Cluster]], boxes: Sequence[Discovered]) -> list[tuple[int, Cluster]]:
    """The clusters of one scan, each with the number of its chain, after returns have moved to nearer boxes."""
    points: dict[int, list[np.ndarray]] = {}
    seconds = {number: cluster.seconds for number, cluster in owned}
    for number, cluster in owned:
        there = [k for k, box in enumerate(boxes) if box.seconds[0] <= cluster.seconds <= box.seconds[-1]]
        others = [k for k in there if k != number and (beyond(boxes[k], cluster) < REACH).any()]
        distances = np.stack([beyond(boxes[k], cluster) for k in (number, *others)])
        distances[1:][distances[1:] >= REACH] = np.inf
        nearest = np.array([number, *others])[distances.argmin(axis=0)]
        for k in np.unique(nearest):
            points.setdefault(int(k), []).append(cluster.points[nearest == k])
            seconds.setdefault(int(k), cluster.seconds)
    origin, scan = owned[0][1].origin, owned[0][1].scan
    joined = {number: np.concatenate(own) for number, own in points.items()}
    return [
        (number, Cluster(scan, seconds[number], own, origin))
        for number, own in joined.items()
        if len(own) >= MIN_RETURNS
    ]


def beyond(box: Discovered, cluster: Cluster) -> Float[np.ndarray, " n"]:
    """The horizontal distances (metres) of a cluster's returns from the sides of a box at the cluster's time, negative
    inside."""
    pose = box.poses(np.array([cluster.seconds]))[0]
    local = np.abs((cluster.points - pose[:3, 3]) @ pose[:3, :3])[:, :2]
    half = 0.5 * box.size[:2]
    outside = np.linalg.norm(np.maximum(local - half, 0.0), axis=1)
    return np.where(outside > 0.0, outside, -(half - local).min(axis=1))
