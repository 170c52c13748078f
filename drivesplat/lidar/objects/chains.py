"""Chains of clusters over consecutive scans: data association with limits of motion and of appearance."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from drivesplat.lidar.objects.clusters import Chain, Cluster

MAX_SPEED = 35.0
"""Metres per second of an object: 126 km/h."""
MAX_ACCELERATION = 8.0
"""Metres per second squared: full braking on a dry road."""
GATE, GATE_SPEED = 0.8, 3.0
"""Metres, and metres per second since it was last seen, by which an object may deviate from its straight way."""
MAX_GAP_S = 1.2
"""Seconds after which a chain that was not seen ends."""
ESTABLISHED = 3
"""Clusters from which the velocity of a chain is known: such chains choose first. The next cluster of a shorter chain
has to look like its last one, since nothing else tells that both are one object."""
LENGTH_CHANGE, LENGTH_SHARE = 0.8, 0.3
"""Metres, and fraction of the larger one, by which the extents of an object typically change from scan to scan."""
TOP_CHANGE = 0.6
"""Metres by which its highest return typically changes: a few beams."""
COUNT_RATIO = 4.0
"""Ratio by which the number of its returns typically changes."""
TYPICAL = 5
"""Last clusters of a chain by whose medians its appearance is known."""
UNLIKE = 1.2
"""Difference in appearance that is allowed to established chains: another object hides a part of them at times."""
LIKENESS = 1.0
"""Weight of a difference in appearance that is just allowed, relative to a place at the border of its gate."""

REFUSED = 1.0 + LIKENESS * UNLIKE
"""Cost of a chain that does not go on."""


def chains_of(clusters: Sequence[Sequence[Cluster]]) -> list[Chain]:
    """Chains of the clusters of consecutive scans. Established chains choose first, then those of two clusters, which
    have a direction, then single clusters, which can go on anywhere within MAX_SPEED."""
    open_: list[Chain] = []
    closed: list[Chain] = []
    for found in clusters:
        if not found:
            continue
        now = float(np.mean([cluster.seconds for cluster in found]))
        closed += [chain for chain in open_ if now - chain.clusters[-1].seconds > MAX_GAP_S]
        open_ = [chain for chain in open_ if now - chain.clusters[-1].seconds <= MAX_GAP_S]
        left = list(found)
        by_length: dict[int, list[Chain]] = {ESTABLISHED: [], 2: [], 1: []}
        for chain in open_:
            by_length[min(len(chain.clusters), ESTABLISHED)].append(chain)
        for chains in by_length.values():
            left = _continued(chains, left)
        open_ += [Chain([cluster]) for cluster in left]
    return closed + open_


def _continued(chains: Sequence[Chain], found: Sequence[Cluster]) -> list[Cluster]:
    """Appends to each chain the cluster of a scan that continues it, if any; the clusters that are left."""
    if not chains or not found:
        return list(found)
    costs = np.stack([_costs(chain, found) for chain in chains])
    rows, columns = linear_sum_assignment(np.minimum(costs, REFUSED))
    taken = set()
    for row, column in zip(rows, columns, strict=True):
        if costs[row, column] < REFUSED:
            chains[row].clusters.append(found[column])
            taken.add(int(column))
    return [cluster for k, cluster in enumerate(found) if k not in taken]


def _costs(chain: Chain, found: Sequence[Cluster]) -> Float[np.ndarray, " n"]:
    """How badly each cluster continues a chain: its distance from where the chain is expected, relative to the gate,
    and its difference in appearance; infinite beyond the gate."""
    last = chain.clusters[-1]
    place, velocity = chain.motion_at(-1)
    since = np.array([cluster.seconds for cluster in found]) - last.seconds
    places = np.stack([cluster.place for cluster in found])
    apart = np.linalg.norm(places - place - since[:, None] * velocity, axis=1)
    if len(chain.clusters) == 1:
        gate = GATE + MAX_SPEED * since
    elif len(chain.clusters) < ESTABLISHED:
        gate = GATE + 0.5 * MAX_ACCELERATION * since**2 + GATE_SPEED * since
    else:
        gate = GATE + GATE_SPEED * since
    within = (apart <= gate) & (np.linalg.norm(places - last.place, axis=1) <= GATE + MAX_SPEED * since)
    costs = np.full(len(found), np.inf)
    for k in np.flatnonzero(within):
        differs = unlikeness(chain.clusters[-TYPICAL:], found[k])
        if differs < (UNLIKE if len(chain.clusters) >= ESTABLISHED else 1.0):
            costs[k] = apart[k] / gate[k] + LIKENESS * differs
    return costs


def unlikeness(known: Sequence[Cluster], new: Cluster) -> float:
    """How much a cluster differs from the `known` ones of a chain, by medians of their extents, highest returns and
    numbers of returns: 1 and more is not one object a moment later."""
    lengths, tops, counts = np.array([_appearance(cluster) for cluster in known]).T
    length, top, count = _appearance(new)
    typical = float(np.median(lengths))
    by_length = (length - typical) / (LENGTH_CHANGE + LENGTH_SHARE * max(length, typical))
    by_top = (top - np.median(tops)) / TOP_CHANGE
    by_count = (count - np.median(counts)) / np.log(COUNT_RATIO)
    return 0.5 * float(np.linalg.norm([by_length, by_top, by_count]))


def _appearance(cluster: Cluster) -> tuple[float, float, float]:
    """The diagonal of its horizontal extents and the height of its highest return (metres), and the logarithm of the
    number of its returns."""
    diagonal = np.linalg.norm(np.ptp(cluster.points[:, :2], axis=0))
    return float(diagonal), float(cluster.points[:, 2].max()), float(np.log(len(cluster.points)))
