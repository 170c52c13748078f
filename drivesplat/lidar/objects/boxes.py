"""Boxes around chains of clusters: heading, size and class, and the motion of the box's centre.

A LiDAR sees the sides of an object that face it. The size of a vehicle that was never seen whole is that of its class,
and its box is placed by the sides that were seen.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline

from drivesplat.lidar.objects.clusters import Chain, Cluster
from drivesplat.scene.object_class import ObjectClass

MIN_HEADING_SPEED = 0.4
"""Metres per second below which a direction of motion says nothing of the heading."""
RICH = 8
"""Returns of a cluster whose extents count."""
WHOLE = 0.8
"""Fraction of a length or width from which extents count as seen whole."""
SEEN = (97.0, 85.0)
"""Percentiles of lengths and widths over all clusters that count as seen: at times a cluster holds two objects."""
BESIDE, CUT = 0.1, 0.01
"""Weights of a coordinate of a vehicle beside the sensor whose ends were not seen, and of one that is partly too near
to be measured."""
NEAR_BLIND = 0.5
"""Metres beyond the range from which returns are measured, within which a cluster may be cut off there."""
MARGIN = 0.05
"""Metres between the outermost returns of a cluster and the surface, on average."""
PERSON, CYCLIST, CAR, TRUCK = (
    np.array(size) for size in ((0.7, 0.7, 1.75), (1.8, 0.7, 1.7), (4.6, 1.9, 1.6), (8.0, 2.5, 3.0))
)
"""Typical length, width and height in metres."""
WIDEST = {ObjectClass.CAR: 2.2, ObjectClass.TRUCK: 2.6}
"""Metres; wider clusters hold more than one object."""
DEGREE = 3
KNOT_S = 0.5
"""Seconds between knots, or more where places are rarer."""
JERK = 0.0125
"""Weight in s⁶ of the mean squared jerk, for each place, relative to squared deviations of weight 1. It grows with the
number of places, since their errors last: an object that is seen in part is misplaced in many scans, one after the
other."""
ACCELERATION = 0.02
"""Weight in s³ of the integral of squared accelerations. It keeps paths of few places straight."""
OUTLIER = 0.2
"""Metres beyond which a deviation counts linearly (Huber)."""
MIN_SPAN_S = 0.5
"""Seconds that shorter paths count as, in the weight of jerks."""
ROUNDS = 6


@dataclass(frozen=True)
class SmoothPath:
    """A path in the plane, twice continuously differentiable; straight on at constant velocity beyond its ends."""

    spline: BSpline
    first: float
    last: float

    def places(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        within = np.clip(seconds, self.first, self.last)
        return self.spline(within) + (seconds - within)[:, None] * self.velocities(within)

    def velocities(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """Metres per second."""
        return self.spline.derivative()(np.clip(seconds, self.first, self.last))

    def accelerations(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """Metres per second squared."""
        return self.spline.derivative(2)(np.clip(seconds, self.first, self.last))


@dataclass(frozen=True)
class Discovered:
    """A moving object: its class, `size` (3,) length, width, height in metres, the path of its box's centre in the
    plane, headings (radians) at `seconds` (k,), in which it was seen, and the height of the ground below it there."""

    object_class: ObjectClass
    size: Float[np.ndarray, "3"]
    path: SmoothPath
    seconds: Float[np.ndarray, " k"]
    headings: Float[np.ndarray, " k"]
    grounds: Float[np.ndarray, " k"]
    returns: int

    def poses(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """Object to world at the box's centre."""
        poses = np.tile(np.eye(4), (len(seconds), 1, 1))
        headings = np.interp(seconds, self.seconds, np.unwrap(self.headings))
        poses[:, 0, 0] = poses[:, 1, 1] = np.cos(headings)
        poses[:, 1, 0], poses[:, 0, 1] = np.sin(headings), -np.sin(headings)
        poses[:, :2, 3] = self.path.places(seconds)
        poses[:, 2, 3] = np.interp(seconds, self.seconds, self.grounds) + 0.5 * self.size[2]
        return poses


def fitted_box(chain: Chain, grounds: Float[np.ndarray, " k"], blind: float = 0.0) -> Discovered:
    """The box of a chain; `grounds` are the heights (metres) of the ground below its clusters. Returns nearer than
    `blind` metres to the sensor are missing."""
    seconds, clusters = chain.seconds, chain.clusters
    weights = np.sqrt([len(cluster.points) for cluster in clusters])
    rough = smooth_path(seconds, chain.places, np.tile(weights[:, None], 2))
    headings = headings_of(rough, seconds)
    axes = [(np.cos(heading), np.sin(heading)) for heading in headings]
    frames = [np.array([[cos, sin], [-sin, cos]]) for cos, sin in axes]  # rows ahead, left
    extents = np.empty((len(clusters), 2, 2))
    for own, cluster, frame in zip(extents, clusters, frames, strict=True):
        places = cluster.points[:, :2] @ frame.T
        stray = 1.0 if len(places) >= 50 else 0.0  # percent of large clusters
        own[:, 0], own[:, 1] = np.percentile(places, stray, axis=0), np.percentile(places, 100.0 - stray, axis=0)
    lengths = extents[:, :, 1] - extents[:, :, 0]
    rich = np.array([len(cluster.points) >= RICH for cluster in clusters])
    chosen = lengths[rich] if rich.any() else lengths
    seen = np.array([np.percentile(chosen[:, k], share) for k, share in enumerate(SEEN)]) + MARGIN
    height = float(np.percentile([np.percentile(c.points[:, 2], 95) for c in clusters] - grounds, 75))
    speed = float(np.median(np.linalg.norm(rough.velocities(seconds), axis=1)))
    object_class, size = class_and_size(seen, height, speed)
    centers, trusts = zip(
        *(_center(*of_one, size[:2], blind) for of_one in zip(clusters, frames, extents, strict=True)), strict=True
    )
    in_world = np.stack([center @ frame for center, frame in zip(centers, frames, strict=True)])
    squared = np.stack([trust @ (frame**2) for trust, frame in zip(trusts, frames, strict=True)])
    path = smooth_path(seconds, in_world, weights[:, None] * squared)
    returns = sum(len(cluster.points) for cluster in clusters)
    return Discovered(object_class, size, path, seconds, headings_of(path, seconds), grounds, returns)


def headings_of(path: SmoothPath, seconds: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """The directions of motion in radians; while it stands, those before and after."""
    velocities = path.velocities(seconds)
    moving = np.linalg.norm(velocities, axis=1) > MIN_HEADING_SPEED
    if not moving.any():
        moving[:] = True
    headings = np.unwrap(np.arctan2(velocities[moving, 1], velocities[moving, 0]))
    return np.interp(seconds, seconds[moving], headings)


def class_and_size(
    seen: Float[np.ndarray, "2"], height: float, speed: float
) -> tuple[ObjectClass, Float[np.ndarray, "3"]]:
    """The class by the length and width that were seen (metres), the height above ground and the typical speed (m/s);
    and the size, by that of the class where less was seen."""
    length, width = seen
    tall = float(np.clip(height, 0.5, 4.5))
    if max(length, width) < 1.3 and speed < 3.5:
        return ObjectClass.PEDESTRIAN, np.array([*np.maximum(seen, 0.6 * PERSON[:2]), max(tall, 0.8)])
    if width < 1.4 and length < 2.6 and tall > 1.2 and speed < 12.0:
        return ObjectClass.BICYCLE, np.array([max(length, CYCLIST[0]), max(width, CYCLIST[1]), tall])
    typical, found = (TRUCK, ObjectClass.TRUCK) if length > 6.5 or tall > 2.6 else (CAR, ObjectClass.CAR)
    sides = np.where(seen > WHOLE * typical[:2], seen, typical[:2])
    sides[1] = min(sides[1], WIDEST[found])
    return found, np.array([*sides, tall if tall > 0.7 * typical[2] else typical[2]])


def _center(
    cluster: Cluster,
    frame: np.ndarray,
    extents: Float[np.ndarray, "2 2"],
    size: Float[np.ndarray, "2"],
    blind: float,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The centre of a box of `size` by the sides that a cluster shows, along both axes, and how far each coordinate is
    to be trusted. Of a cluster next to where returns are missing, the near sides may be missing, too."""
    sensor = frame @ cluster.origin[:2]
    low, high = extents.T
    before, behind = sensor < low, sensor > high
    fits = high - low < size
    anchored = 0.5 * (low + high)
    anchored = np.where(before & fits, low + 0.5 * size, anchored)
    anchored = np.where(behind & fits, high - 0.5 * size, anchored)
    whole = high - low >= WHOLE * size
    trust = np.where(whole | before | behind, 1.0, BESIDE)
    if np.linalg.norm(cluster.points - cluster.origin, axis=1).min() < blind + NEAR_BLIND:
        trust = np.where(whole, trust, CUT)
    return anchored, trust


def smooth_path(
    seconds: Float[np.ndarray, " k"], places: Float[np.ndarray, "k 2"], weights: Float[np.ndarray, "k 2"]
) -> SmoothPath:
    """The path that is near `places` (metres) at increasing `seconds`: the least sum of weighted squared deviations, of
    squared accelerations and of squared jerks. `weights` are those of each coordinate."""
    first, last = float(seconds[0]), float(seconds[-1])
    spans = max(1, min(int(np.ceil((last - first) / KNOT_S)), len(seconds)))
    inner = np.linspace(first, max(last, first + 1e-3), spans + 1)
    knots = np.concatenate([np.full(DEGREE, inner[0]), inner, np.full(DEGREE, inner[-1])])
    design = BSpline.design_matrix(np.clip(seconds, inner[0], inner[-1]), knots, DEGREE).toarray()
    straight = ACCELERATION * _integral_of_squares(knots, inner, 2)
    even = JERK * len(seconds) / max(last - first, MIN_SPAN_S) * _integral_of_squares(knots, inner, 3)
    middle = places.mean(axis=0)
    coefficients = np.zeros((design.shape[1], 2))
    for axis in range(2):
        own, wanted = weights[:, axis].copy(), places[:, axis] - middle[axis]
        for _ in range(ROUNDS):
            normal = design.T @ (own[:, None] * design) + straight
            normal += 1e-9 * np.trace(normal) * np.eye(len(normal)) + even
            coefficients[:, axis] = np.linalg.solve(normal, design.T @ (own * wanted))
            off = np.abs(wanted - design @ coefficients[:, axis])
            own = weights[:, axis] * np.minimum(1.0, OUTLIER / np.maximum(off, 1e-9))
    coefficients += middle  # B-splines add up to 1
    return SmoothPath(BSpline(knots, coefficients, DEGREE), first, last)


def _integral_of_squares(knots: np.ndarray, inner: np.ndarray, order: int) -> np.ndarray:
    """The quadratic form of the integral of the squared second or third derivative; exact, as these are at most linear
    between knots."""
    derivative = BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE).derivative(order)
    middles, halves = 0.5 * (inner[1:] + inner[:-1]), 0.5 * np.diff(inner)
    values = [derivative(middles + sign * halves / np.sqrt(3.0)) for sign in (-1.0, 1.0)]
    return sum(value.T @ (halves[:, None] * value) for value in values)
