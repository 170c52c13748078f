"""Objects that come near each other: returns of one cluster that belong to two of them.

A cluster of returns that lie close together holds both while two objects pass each other. Its middle belongs to
neither, and its extents make the box of either too large.
"""

from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np
from jaxtyping import Float

from drivesplat.lidar.objects.boxes import Discovered
from drivesplat.lidar.objects.clusters import MIN_RETURNS, Chain, Cluster

REACH = 0.5
"""Metres beyond a box in which returns may belong to its object."""


def separated(chains: Sequence[Chain], boxes: Sequence[Discovered]) -> list[Chain]:
    """The chains with each return of their clusters in the chain to whose box it is nearest at the cluster's time.

    `boxes` are those of the chains. Returns that no other box reaches stay where they are. Clusters with fewer than
    MIN_RETURNS returns left are dropped.
    """
    owned = sorted(
        ((number, cluster) for number, chain in enumerate(chains) for cluster in chain.clusters),
        key=lambda it: it[1].scan,
    )
    # For each cluster the distances of its returns from the box of its chain and from each other box of its time.
    owners, seconds = np.array([number for number, _ in owned]), np.array([cluster.seconds for _, cluster in owned])
    distances: list[dict[int, np.ndarray]] = [{} for _ in owned]
    for number, box in enumerate(boxes):
        in_time = (box.seconds[0] <= seconds) & (seconds <= box.seconds[-1])
        there = np.flatnonzero(in_time | (owners == number))
        for k, pose in zip(there, box.poses(seconds[there]), strict=True):
            distances[k][number] = beyond(box, pose, owned[k][1].points)
    made = [Chain() for _ in chains]
    for _, of_scan in groupby(zip(owned, distances, strict=True), key=lambda it: it[0][1].scan):
        for number, cluster in _of_scan(list(of_scan)):
            made[number].clusters.append(cluster)
    return made


def _of_scan(owned: Sequence[tuple[tuple[int, Cluster], Mapping[int, np.ndarray]]]) -> list[tuple[int, Cluster]]:
    """The clusters of one scan, each with the number of its chain, after returns have moved to nearer boxes; given with
    the distances of their returns from boxes, by the number of the box."""
    points: dict[int, list[np.ndarray]] = {}
    seconds = {number: cluster.seconds for (number, cluster), _ in owned}
    for (number, cluster), distances in owned:
        others = {k: values for k, values in distances.items() if k != number and (values < REACH).any()}
        reached = [np.where(values < REACH, values, np.inf) for values in others.values()]
        nearest = np.array([number, *others])[np.stack([distances[number], *reached]).argmin(axis=0)]
        for k in np.unique(nearest):
            points.setdefault(int(k), []).append(cluster.points[nearest == k])
            seconds.setdefault(int(k), cluster.seconds)
    (_, first), _ = owned[0]
    joined = {number: np.concatenate(own) for number, own in points.items()}
    return [
        (number, Cluster(first.scan, seconds[number], own, first.origin))
        for number, own in joined.items()
        if len(own) >= MIN_RETURNS
    ]


def beyond(
    box: Discovered, pose: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """The horizontal distances (metres) of points in the world from the sides of a box at a pose (object to world),
    negative inside."""
    local = np.abs((points - pose[:3, 3]) @ pose[:3, :3])[:, :2]
    half = 0.5 * box.size[:2]
    outside = np.linalg.norm(np.maximum(local - half, 0.0), axis=1)
    return np.where(outside > 0.0, outside, -(half - local).min(axis=1))
