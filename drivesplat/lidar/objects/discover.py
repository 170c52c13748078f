"""Moving objects of a drive from its LiDAR scans: evidence, clusters, chains, boxes."""

from collections.abc import Sequence
from itertools import combinations, pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from drivesplat.lidar.ground import GroundMap
from drivesplat.lidar.objects.boxes import Discovered, fitted_box
from drivesplat.lidar.objects.chains import chains_of
from drivesplat.lidar.objects.clusters import Chain, Cluster, clusters_of
from drivesplat.lidar.objects.ends import Ends
from drivesplat.lidar.objects.merging import after_gaps, of_parts, united
from drivesplat.lidar.objects.seen_empty import seen_empty
from drivesplat.lidar.objects.separation import separated
from drivesplat.lidar.objects.standing import StandingMap
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan_record import RecordedScan

MIN_SCANS, MIN_SECONDS, MIN_WAY = 4, 0.4, 1.0
"""Scans, seconds and metres of a chain that is an object: chance makes chains of three clusters."""
PART_SCANS = 3
"""Scans of a chain that is a part of an object."""
MIN_FILL = 0.35
"""Fraction of the scans between its first and its last one in which it was found."""
MIN_TYPICAL = 4.0
"""Median number of returns of its clusters."""
STRAIGHT = 0.5
"""Least ratio of the distance between its ends to the length of its way."""
SAME_VELOCITY, SAME_SHARE = 2.5, 0.5
"""Metres per second, and fraction of the speed, by which the velocities of parts of one object seem to differ."""
SLACK = (1.0, 0.3)
"""Metres along and across a vehicle by which the middles of its parts may lie beyond its box."""
MAX_NEITHER_S, MAX_BOTH_S = 1.0, 0.5
"""Seconds between the end of one box and the begin of another one of the same object, and for which both may be."""
SETTLED_S = 0.5
"""Seconds from its ends within which the velocity of a path is uncertain."""
MEET, MEET_SPEED = 0.7, 1.0
"""Metres, and metres per second of the time between, by which the two may be apart then; half of the length and
of the width of a vehicle more, of which each may show another part."""
NEARLY_ALWAYS, FEW = 0.75, 0.1
"""Fractions of their common time, and of the returns of the larger one."""
MAX_CLEARANCE = 0.8
"""Metres between the ground and the lowest return of an object. Far away it is the height of a kerb and twice the
distance of two beams there, where that is more."""
MIN_MOVING = 0.4
"""Fraction of the returns in the place of an object that move."""
BESIDE, KERB = 0.2, 0.3
"""Metres around a cluster, and above the ground, where returns are counted for it."""
MAX_BLOCKED = 0.05
"""Fraction of its way on which an object may pass through what stands: paths are off by some decimetres in places."""
MISFIT_LINK, MISFIT = 0.3, 0.15
"""Metres between the surfaces that an object shows in two scans: at most, beside the distance of neighbouring beams,
and for half of them, beside half of that distance and what UNKNOWN_ACCELERATION (metres per second squared), which
smooth paths miss, adds from scan to scan."""
UNKNOWN_ACCELERATION = 2.0
MAX_POINTS = 100
"""Returns of a cluster that are looked at, evenly chosen."""
FREE = 3.0
"""Factor on the distance of surfaces that were moved until they fit: chance makes it small."""
MAX_ACCELERATION = 5.0
"""Metres per second squared, for half of the time, of an object: brisk braking, or a turn taken at speed."""
MAX_SEPARATIONS = 8
"""Rounds in which boxes and the returns that belong to them are found by turns."""
Boxed = tuple[Chain, Discovered]
"""A chain and its box."""
GROUND_REACH = 40.0
"""Metres from the sensor within which returns count for the map of the ground: far ahead the beams pass above and below
the road. The vehicle comes there later, and sees it from near."""
GROUND_SCANS = 100
"""Number of scans, evenly spaced, that are enough for that map."""


def discovered(scans: Sequence[RecordedScan], threads: int = 1) -> list[Discovered]:
    """The moving objects in the scans of one LiDAR, which are in order of time, in the order in which they appear."""
    moving = seen_empty(scans, threads)
    clusters = [clusters_of(scan, k, own) for k, (scan, own) in enumerate(zip(scans, moving, strict=True))]
    around = Surroundings(scans, moving)
    standing = StandingMap(scans, moving, around.ground)
    chains = [part for chain in chains_of(clusters) for part in around.parts(chain, standing)]
    long = [chain for chain in chains if len(chain.clusters) >= PART_SCANS]
    whole = after_gaps(of_parts(long), standing.blocked_link)
    boxes = [around.boxed(chain) for chain in whole if is_object(chain) and around.confirm(chain)]
    boxes = [boxed for boxed in boxes if around.is_possible(boxed, standing)]
    boxes = _without_overlaps(boxes, around)
    for _ in range(MAX_SEPARATIONS if boxes else 0):  # boxes and the returns that belong to each, until these stay
        before = [_counts(chain) for chain, _ in boxes]
        chains = [chain for chain in separated(*zip(*boxes, strict=True)) if len(chain.clusters) >= PART_SCANS]
        if [_counts(chain) for chain in chains] == before:
            break
        boxes = [around.boxed(chain) for chain in chains]
    ends = Ends(scans)
    found = [boxed for boxed in _without_overlaps(boxes, around) if around.is_possible(boxed, standing)]
    return sorted((ends.followed(item) for _, item in found), key=lambda it: it.seconds[0])


def _counts(chain: Chain) -> list[tuple[int, int]]:
    return [(cluster.scan, len(cluster.points)) for cluster in chain.clusters]


def _without_overlaps(boxes: Sequence[Boxed], around: "Surroundings") -> Sequence[Boxed]:
    """Chains with their boxes, joined where two are of one object."""
    while True:
        pairs = ((i, j) for i, j in combinations(range(len(boxes)), 2) if are_one(boxes[i][1], boxes[j][1]))
        pair = next(pairs, None)
        if pair is None:
            return boxes
        whole = united(*(boxes[k][0] for k in pair))
        boxes = [it for k, it in enumerate(boxes) if k not in pair] + [around.boxed(whole)]


def are_one(a: Discovered, b: Discovered) -> bool:
    """Whether two boxes are of one object, at the same time or one after the other."""
    return overlap(a, b) or continues(a, b) or continues(b, a)


def continues(a: Discovered, b: Discovered) -> bool:
    """Whether a box goes on as another one, of similar kind, that began about when it ended: half-way between, both are
    at one place, and SETTLED_S before and after, their velocities are alike."""
    gap = float(b.seconds[0] - a.seconds[-1])
    if not -MAX_BOTH_S <= gap <= MAX_NEITHER_S or b.seconds[-1] <= a.seconds[-1] or b.seconds[0] <= a.seconds[0]:
        return False
    if a.object_class.is_human != b.object_class.is_human:
        return False
    between = np.array([0.5 * (a.seconds[-1] + b.seconds[0])])
    apart = b.path.places(between)[0] - a.path.places(between)[0]
    before, after = a.path.velocities(between - SETTLED_S)[0], b.path.velocities(between + SETTLED_S)[0]
    speed = max(float(np.linalg.norm(before)), float(np.linalg.norm(after)))
    way = (before + after) / max(float(np.linalg.norm(before + after)), 1e-6)
    along, across = abs(float(apart @ way)), abs(float(apart[0] * way[1] - apart[1] * way[0]))
    reach = MEET + MEET_SPEED * max(gap, 0.0)
    alike = float(np.linalg.norm(before - after)) <= max(SAME_VELOCITY, SAME_SHARE * speed)
    length, width = np.zeros(2) if a.object_class.is_human else 0.25 * (a.size + b.size)[:2]
    return bool(alike and across <= reach + width and along <= reach + length)


def overlap(a: Discovered, b: Discovered) -> bool:
    """Whether two boxes are of one object: over their common time the centre of one mostly lies in the other, with
    SLACK about vehicles, and they move alike; or it nearly always lies in a truck, on whose side patches seem to slide,
    or in a box with many more returns."""
    first, last = max(a.seconds[0], b.seconds[0]), min(a.seconds[-1], b.seconds[-1])
    if last <= first:
        return False
    seconds = np.linspace(first, last, 10)
    velocities = [item.path.velocities(seconds) for item in (a, b)]
    speed = max(float(np.median(np.linalg.norm(own, axis=1))) for own in velocities)
    differ_by = float(np.median(np.linalg.norm(velocities[0] - velocities[1], axis=1)))
    alike = differ_by <= max(SAME_VELOCITY, SAME_SHARE * speed)
    for outer, inner in ((a, b), (b, a)):
        slack = np.zeros(2) if outer.object_class.is_human else np.array(SLACK)
        if alike and _share_inside(outer, inner, seconds, slack) > 0.5:
            return True
        is_patch = outer.object_class is ObjectClass.TRUCK or inner.returns < FEW * outer.returns
        if is_patch and _share_inside(outer, inner, seconds, np.zeros(2)) > NEARLY_ALWAYS:
            return True
    return False


def _share_inside(outer: Discovered, inner: Discovered, seconds: np.ndarray, slack: np.ndarray) -> float:
    """The fraction of the times at which the centre of a box lies in another one, enlarged by `slack` (2,) metres."""
    poses, places = outer.poses(seconds), inner.poses(seconds)[:, :3, 3]
    local = np.einsum("nji,nj->ni", poses[:, :3, :3], places - poses[:, :3, 3])
    return float((np.abs(local[:, :2]) < 0.5 * outer.size[:2] + slack).all(axis=1).mean())


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


class Surroundings:
    """What the scans say around clusters: the height of the ground, returns that do not move, and the range below which
    nothing is measured."""

    def __init__(self, scans: Sequence[RecordedScan], moving: Sequence[Bool[np.ndarray, " _"]]):
        self._scans, self._moving = scans, moving
        elevations = np.sort(scans[0].scan.rays.beam_elevations)
        self._spacing = float(np.median(np.diff(elevations))) if len(elevations) > 1 else 0.0
        self.ground = ground_of(scans, moving).height
        # Nearer returns are not measured, as they are of the ego vehicle.
        self._blind = max(float(s.scan.ranges[s.scan.returned & ~s.measured].max(initial=0.0)) for s in scans)
        self._standing: dict[int, tuple[cKDTree, np.ndarray]] = {}

    def boxed(self, chain: Chain) -> Boxed:
        """A chain with its box, on the ground: where its height is unknown, between known ones, or on the height of the
        lowest returns."""
        heights = np.array([self.ground(cluster.place) for cluster in chain.clusters])
        known = np.isfinite(heights)
        if known.any():
            grounds = np.interp(chain.seconds, chain.seconds[known], heights[known])
        else:
            grounds = np.full(len(heights), min(cluster.lowest for cluster in chain.clusters))
        return chain, fitted_box(chain, grounds, self._blind)

    def confirm(self, chain: Chain) -> bool:
        """Whether a chain mostly reaches down to the ground, as leaves and signs do not, and most returns in its place
        move, as those of standing objects do not."""
        clearances = np.array([cluster.lowest - self.ground(cluster.place) for cluster in chain.clusters])
        beams_apart = [self._beams_apart(cluster) for cluster in chain.clusters]
        excess = clearances - [max(MAX_CLEARANCE, KERB + 2 * apart) for apart in beams_apart]
        if not np.isfinite(excess).any() or np.nanmedian(excess) >= 0.0:
            return False
        moving_shares = []  # of the returns in a cluster's extents, above the ground where it is known
        for cluster in chain.clusters:
            ground = self.ground(cluster.place)
            floor = min(ground, cluster.lowest) + KERB if np.isfinite(ground) else -np.inf
            tree, heights = self._of_scan(cluster.scan)
            low, high = cluster.points.min(axis=0) - BESIDE, cluster.points.max(axis=0) + BESIDE
            reach = 0.5 * float(np.linalg.norm(high[:2] - low[:2]))
            near = np.array(tree.query_ball_point(cluster.place, reach), dtype=np.int64)
            places, z = tree.data[near], heights[near]
            inside = (places >= low[:2]).all(axis=1) & (places <= high[:2]).all(axis=1)
            standing = int((inside & (z > floor) & (z <= high[2])).sum())
            own = int((cluster.points[:, 2] > floor).sum())
            moving_shares.append(own / max(own + standing, 1))
        return bool(np.median(moving_shares) > MIN_MOVING)

    def parts(self, chain: Chain, standing: StandingMap) -> list[Chain]:
        """The parts of a chain between which it would pass through what stands, or whose surfaces differ."""
        parts = [Chain([chain.clusters[0]])]
        for before, after in pairwise(chain.clusters):
            allowed = MISFIT_LINK + self._beams_apart(after)
            if standing.blocked_link(before, after) or least_misfit(before, after) > allowed:
                parts.append(Chain())
            parts[-1].clusters.append(after)
        return parts

    def is_possible(self, boxed: Boxed, standing: StandingMap) -> bool:
        """Whether an object can move as a box does: it passes through nothing that stands, its surface moves with the
        box, and no vehicle or person speeds up and turns so much."""
        chain, item = boxed
        seconds = np.linspace(item.seconds[0], item.seconds[-1], 4 * len(item.seconds))
        acceleration = float(np.median(np.linalg.norm(item.path.accelerations(seconds), axis=1)))
        apart = float(np.median([self._beams_apart(cluster) for cluster in chain.clusters]))
        unknown = 0.5 * UNKNOWN_ACCELERATION * float(np.median(np.diff(chain.seconds))) ** 2
        allowed = MISFIT + 0.5 * apart + unknown
        return (
            acceleration <= MAX_ACCELERATION
            and misfit_along(chain, item) <= allowed
            and standing.blocked_share(item) <= MAX_BLOCKED
        )

    def _beams_apart(self, cluster: Cluster) -> float:
        """Metres between neighbouring beams at the distance of a cluster."""
        return self._spacing * float(np.linalg.norm(cluster.place - cluster.origin[:2]))

    def _of_scan(self, number: int) -> tuple[cKDTree, np.ndarray]:
        """The places of the returns of a scan that do not move, and their heights."""
        if number not in self._standing:
            points = self._scans[number].points()[~self._moving[number]]
            self._standing[number] = cKDTree(points[:, :2]), points[:, 2]
        return self._standing[number]


def ground_of(scans: Sequence[RecordedScan], moving: Sequence[Bool[np.ndarray, " _"]]) -> GroundMap:
    """The map of the ground by the measured returns of scans without those that are `moving`, an array for each
    scan."""
    chosen = np.unique(np.linspace(0, len(scans) - 1, GROUND_SCANS).round().astype(int))
    near = []
    for k in chosen:
        points = scans[k].points()[~moving[k]]
        near.append(points[np.linalg.norm(points - scans[k].sensor_to_world[:3, 3], axis=1) < GROUND_REACH])
    return GroundMap(np.concatenate(near))
