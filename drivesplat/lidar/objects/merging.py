"""Chains that belong to one object: one after the other, where it was hidden, or side by side, where it fell apart."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from drivesplat.lidar.objects.clusters import Chain, Cluster

MAX_HIDDEN_S, MAX_COMMON_S = 2.5, 0.3
"""Seconds for which an object may be hidden, and by which two chains of it may overlap."""
HIDDEN_APART, HIDDEN_APART_SPEED = 1.2, 1.0
"""Metres, and metres per second of the gap, by which it may reappear elsewhere than expected."""
SAME_VELOCITY, SAME_SHARE = 1.5, 0.5
"""Metres per second, and fraction of the speed, by which the velocities before and after a gap may differ."""
MAX_LENGTH, MAX_ASIDE = 6.0, 1.2
"""Metres along and across the way between the middles of two parts of one object."""
RIGID = 0.35
"""Metres by which the offset between two parts of one object varies (standard deviation, over their common time)."""
MIN_COMMON_S = 0.4
MIN_SPEED = 2.5
"""Metres per second of objects that may fall apart: people who walk together are not one body."""


def after_gaps(chains: Sequence[Chain], blocked: Callable[[Cluster, Cluster], bool] | None = None) -> list[Chain]:
    """Joins chains that go on where others ended, the best matches first, unless the way from the last cluster of one
    to the first of the other is `blocked`."""
    left = list(chains)
    if not left:
        return left
    ends = [_Ends.of(chain) for chain in left]
    costs = _gap_costs(ends)
    while len(left) > 1:
        i, j = (int(k) for k in np.unravel_index(costs.argmin(), costs.shape))
        if costs[i, j] >= 1.0:
            break
        if blocked is not None and blocked(left[i].clusters[-1], left[j].clusters[0]):
            costs[i, j] = np.inf
            continue
        left[i] = united(left[i], left[j])
        ends[i] = _Ends.of(left[i])
        left, ends = left[:j] + left[j + 1 :], ends[:j] + ends[j + 1 :]
        costs = _gap_costs(ends)
    return left


class _Ends(NamedTuple):
    """The first and the last time of a chain (seconds), its places (metres) and velocities (m/s) then, and the number
    of its clusters."""

    first: float
    last: float
    begin: np.ndarray
    arriving: np.ndarray
    end: np.ndarray
    leaving: np.ndarray
    count: int

    @classmethod
    def of(cls, chain: Chain) -> "_Ends":
        seconds = (chain.clusters[0].seconds, chain.clusters[-1].seconds)
        return cls(*seconds, *chain.motion_at(0), *chain.motion_at(-1), len(chain.clusters))


def _gap_costs(ends: Sequence[_Ends]) -> Float[np.ndarray, "n n"]:
    """The deviation of each chain (column) from where another one (row) would be, relative to what is allowed; 1 and
    more: not joined."""
    first, last, begin, arriving, end, leaving, count = (np.array(column) for column in zip(*ends, strict=True))
    gaps = first[None, :] - last[:, None]
    changes = np.linalg.norm(leaving[:, None] - arriving[None, :], axis=2)
    speeds = np.maximum(np.linalg.norm(leaving, axis=1)[:, None], np.linalg.norm(arriving, axis=1)[None, :])
    alike = SAME_VELOCITY + SAME_SHARE * speeds
    expected = end[:, None] + 0.5 * gaps[..., None] * (leaving[:, None] + arriving[None, :])
    apart = np.linalg.norm(begin[None, :] - expected, axis=2)
    allowed = (gaps > -MAX_COMMON_S) & (gaps <= MAX_HIDDEN_S) & (changes <= alike)
    allowed &= np.minimum(count[:, None], count[None, :]) >= 2
    np.fill_diagonal(allowed, False)
    return np.where(allowed, apart / (HIDDEN_APART + HIDDEN_APART_SPEED * np.maximum(gaps, 0.0)), np.inf)


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
