"""Oriented boxes on the ground: whether they overlap, and when they will.

A box is upright: a rectangle on the ground with a heading, and an interval of heights. Both questions are answered by
the separating axes of the two rectangles (the directions of their sides) and the vertical.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from drivesplat.simulate.driven_run import OtherObject, VehicleShape


@dataclass(frozen=True, eq=False)
class OrientedBoxes:
    """Upright boxes in world metres: their `centre`, the horizontal unit vector `forward`, and `half` their length,
    width and height. Leading dimensions broadcast."""

    centre: Float64[np.ndarray, "*batch 3"]
    forward: Float64[np.ndarray, "*batch 2"]
    half: Float64[np.ndarray, "*sizes 3"]

    @property
    def left(self) -> Float64[np.ndarray, "*batch 2"]:
        """Horizontal unit vectors to the left."""
        return np.stack([-self.forward[..., 1], self.forward[..., 0]], axis=-1)

    @property
    def corners(self) -> Float64[np.ndarray, "*batch 4 2"]:
        """The corners on the ground: front left, front right, rear right, rear left."""
        signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
        along = signs[:, :1] * self.half[..., None, :1] * self.forward[..., None, :]
        return self.centre[..., None, :2] + along + signs[:, 1:] * self.half[..., None, 1:2] * self.left[..., None, :]

    def end(self, side: Float64[np.ndarray, " n"]) -> "OrientedBoxes":
        """The front end of n boxes where `side` is 1, their rear end where it is -1, as boxes of length 0."""
        centre = self.centre.copy()
        centre[:, :2] += (side * self.half[:, 0])[:, None] * self.forward
        return OrientedBoxes(centre, self.forward, self.half * np.array([0.0, 1.0, 1.0]))


def upright_boxes(
    box_to_world: Float64[np.ndarray, "*batch 4 4"], size: Float64[np.ndarray, "*sizes 3"]
) -> OrientedBoxes:
    """Boxes of `size` (length, width, height) at poses of their centres.

    A tilted box keeps its length and width on the ground; its heights are those between its lowest and highest corner.
    """
    rotation = box_to_world[..., :3, :3]
    forward = rotation[..., :2, 0] / np.linalg.norm(rotation[..., :2, 0], axis=-1, keepdims=True)
    half = np.broadcast_to(0.5 * size, (*forward.shape[:-1], 3)).copy()
    half[..., 2] = (np.abs(rotation[..., 2, :]) * half).sum(axis=-1)
    return OrientedBoxes(box_to_world[..., :3, 3], forward, half)


def ego_boxes(ego_to_world: Float64[np.ndarray, "n 4 4"], shape: VehicleShape) -> OrientedBoxes:
    """The boxes of the ego vehicle at poses of its rear axle on the ground."""
    centre = ego_to_world.copy()
    middle = np.array([shape.centre, 0.0, 0.5 * shape.height])
    centre[:, :3, 3] += ego_to_world[:, :3, :3] @ middle
    return upright_boxes(centre, np.array([shape.length, shape.width, shape.height]))


def other_boxes(others: Sequence[OtherObject], steps: int) -> tuple[OrientedBoxes, Bool[np.ndarray, "k n"]]:
    """The boxes (k, n) of k objects at n `steps`, and where they are present; boxes of absent steps are at the origin
    and mean nothing."""
    present = np.array([other.present for other in others], dtype=bool).reshape(len(others), steps)
    poses = np.array([other.object_to_world for other in others], dtype=float).reshape(len(others), steps, 4, 4)
    poses = np.where(present[..., None, None], poses, np.eye(4))
    sizes = np.array([other.size for other in others], dtype=float).reshape(len(others), 1, 3)
    return upright_boxes(poses, sizes), present


def overlapping(a: OrientedBoxes, b: OrientedBoxes) -> Bool[np.ndarray, "..."]:
    """Whether boxes overlap or touch, in their rectangles and in their heights."""
    return (np.abs(_along_axes(a, b, b.centre - a.centre)) <= _reach(a, b)).all(axis=-1)


def time_to_contact(
    a: OrientedBoxes, b: OrientedBoxes, relative_velocity: Float64[np.ndarray, "... 3"]
) -> Float64[np.ndarray, "..."]:
    """Seconds until boxes touch that keep their headings while `b` moves by `relative_velocity` (m/s) as seen from `a`:
    0 where they overlap, inf where they never will.

    On each axis the projections overlap during one interval of time. Boxes that only translate touch when all intervals
    hold, so the time is exact: the latest beginning of an interval, where no interval ends before it.
    """
    distance, speed = (_along_axes(a, b, vector) for vector in (b.centre - a.centre, relative_velocity))
    reach = _reach(a, b)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = np.sort(np.stack([(-reach - distance) / speed, (reach - distance) / speed]), axis=0)
    still, apart = speed == 0.0, np.abs(distance) > reach
    begin = np.where(still, np.where(apart, np.inf, -np.inf), ends[0]).max(axis=-1)
    end = np.where(still, np.where(apart, -np.inf, np.inf), ends[1]).min(axis=-1)
    return np.where((begin <= end) & (end >= 0.0), np.maximum(begin, 0.0), np.inf)


def _along_axes(a: OrientedBoxes, b: OrientedBoxes, vector: np.ndarray) -> np.ndarray:
    """The components (..., 5) of vectors (..., 3) on the separating axes of two boxes: along and across each of both,
    and the vertical."""
    horizontal = [(vector[..., :2] * axis).sum(axis=-1) for axis in (a.forward, a.left, b.forward, b.left)]
    return np.stack([*horizontal, vector[..., 2]], axis=-1)


def _reach(a: OrientedBoxes, b: OrientedBoxes) -> np.ndarray:
    """The distances (..., 5) of centres on each axis within which the projections of two boxes overlap."""
    cos = np.abs((a.forward * b.forward).sum(axis=-1))
    sin = np.abs((a.left * b.forward).sum(axis=-1))
    (a_length, a_width, a_height), (b_length, b_width, b_height) = (np.moveaxis(box.half, -1, 0) for box in (a, b))
    reach = [
        a_length + b_length * cos + b_width * sin,
        a_width + b_length * sin + b_width * cos,
        b_length + a_length * cos + a_width * sin,
        b_width + a_length * sin + a_width * cos,
        a_height + b_height,
    ]
    return np.stack(np.broadcast_arrays(*reach), axis=-1)
