"""Chains that belong to one object: one after the other, where it was hidden, or side by side, where it fell apart."""

from collections.abc import Sequence

import numpy as np

from drivesplat.lidar.objects.clusters import Chain, Cluster

MAX_HIDDEN_S, MAX_COMMON_S = 2.5, 0.3
"""Seconds for which an object may be hidden, and by which two chains of it may overlap."""
HIDDEN_APART, HIDDEN_APART_SPEED = 1.2, 1.0
"""Metres, and metres per second of the gap, by which it may reappear elsewhere than expected."""
SAME_VELOCITY = 4.0
"""Metres per second by which the velocities before and after a gap may differ."""
MAX_LENGTH, MAX_ASIDE = 6.0, 1.2
"""Metres along and across the way between the middles of two parts of one object."""
RIGID = 0.35
"""Metres by which the offset between two parts of one object varies (standard deviation, over their common time)."""
MIN_COMMON_S = 0.4
MIN_SPEED = 2.5
"""Metres per second of objects that may fall apart: people who walk together are not one body."""


def after_gaps(chains: Sequence[Chain]) -> list[Chain]:
    """Joins chains that go on where others ended, the best matches first."""
    left = list(chains)
    while True:
        best, pair = 1.0, None
        for i, before in enumerate(left):
            for j, after in enumerate(left):
                cost = _gap_cost(before, after) if i != j else 1.0
                if cost < best:
                    best, pair = cost, (i, j)
        if pair is None:
            return left
        joined = united(left[pair[0]], left[pair[1]])
        left = [chain for k, chain in enumerate(left) if k not in pair] + [joined]


def _gap_cost(before: Chain, after: Chain) -> float:
    """The deviation of `after` from where `before` would be, relative to what is allowed; 1 and more: not joined."""
    gap = after.clusters[0].seconds - before.clusters[-1].seconds
    if not -MAX_COMMON_S < gap <= MAX_HIDDEN_S or min(len(before.clusters), len(after.clusters)) < 2:
        return 1.0
    (end, leaving), (begin, arriving) = before.motion_at(-1), after.motion_at(0)
    if np.linalg.norm(leaving - arriving) > SAME_VELOCITY:
        return 1.0
    expected = end + 0.5 * gap * (leaving + arriving)
    return float(np.linalg.norm(begin - expected) / (HIDDEN_APART + HIDDEN_APART_SPEED * max(gap, 0.0)))


def of_parts(chains: Sequence[Chain]) -> list[Chain]:
    """Joins chains that move together, near each other: parts of one object."""
    left = sorted(chains, key=lambda chain: -len(chain.clusters))
    found: list[Chain] = []
    for chain in left:
        whole = next((i for i, other in enumerate(found) if _one_body(other, chain)), None)
        if whole is None:
            found.append(chain)
        else:
            found[whole] = united(found[whole], chain)
    return found


def _one_body(a: Chain, b: Chain) -> bool:
    first, last = max(a.seconds[0], b.seconds[0]), min(a.seconds[-1], b.seconds[-1])
    within = b.seconds[(first <= b.seconds) & (b.seconds <= last)]
    if last - first < MIN_COMMON_S or len(within) < 3:
        return False
    at_a = np.stack([np.interp(within, a.seconds, a.places[:, axis]) for axis in range(2)], axis=1)
    at_b = b.places[(first <= b.seconds) & (b.seconds <= last)]
    offsets = at_b - at_a
    way = at_b[-1] - at_b[0]
    distance = float(np.linalg.norm(way))
    if distance < MIN_SPEED * (last - first) or np.linalg.norm(offsets.std(axis=0)) > RIGID:
        return False
    along, aside = np.abs(np.array([way, [-way[1], way[0]]]) @ np.median(offsets, axis=0)) / distance
    return bool(along < MAX_LENGTH and aside < MAX_ASIDE)


def united(a: Chain, b: Chain) -> Chain:
    """Both chains as one, clusters of the same scan as one cluster."""
    by_scan: dict[int, Cluster] = {}
    for cluster in (*a.clusters, *b.clusters):
        other = by_scan.get(cluster.scan)
        if other is None:
            by_scan[cluster.scan] = cluster
            continue
        points = np.concatenate([other.points, cluster.points])
        share = len(cluster.points) / len(points)
        seconds = (1.0 - share) * other.seconds + share * cluster.seconds
        by_scan[cluster.scan] = Cluster(cluster.scan, seconds, points, cluster.origin)
    return Chain(sorted(by_scan.values(), key=lambda cluster: cluster.seconds))
