"""People who walk or stand."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drivesplat.world.shapes.gait import GESTURE_SECONDS, STRIDE, standing, walking
from drivesplat.world.shapes.human import FOREARM, HUMAN_PIECES, Clothing, human_pieces, human_poses, in_metres
from drivesplat.world.shapes.limbs import mean_size, oriented, placed
from drivesplat.world.shapes.mesh import (
    SKIN,
    Color,
    ColoredMesh,
    Material,
    SurfaceClass,
    box,
    concatenate,
    cylinder,
)  # fmt: skip

HAIR, SHOES, BAG = (0.05, 0.035, 0.025), (0.04, 0.035, 0.03), (0.2, 0.1, 0.05)
HAND_OF_BAG = np.array([[0.008, 0.0, -FOREARM - 0.05]])
"""Where the left hand holds the bag, in the forearm's frame, in body heights."""
BAG_ARM_SWING = 0.4
"""Swing of the arm with the bag relative to that of a free arm."""
MIN_HEIGHT, MAX_HEIGHT = 1.5, 1.95


@dataclass(frozen=True)
class Person:
    """A person in a coat. Pieces are those of `HUMAN_PIECES`, then the bag, if any.

    `height` in metres; `walks`: whether the limbs follow the distance travelled or, standing, the seconds; `phase`: the
    share of a cycle by which the motion is ahead.
    """

    height: float
    shirt: Color
    trousers: Color
    bag: bool = False
    walks: bool = True
    hair: Color = HAIR
    skin: Color = SKIN
    phase: float = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator, walks: bool = True) -> "Person":
        """A person with random height, colours, bag and phase."""
        return cls(
            height=float(np.clip(rng.normal(1.72, 0.09), MIN_HEIGHT, MAX_HEIGHT)),
            shirt=drawn_color(rng, 0.04, 0.4), trousers=drawn_color(rng, 0.03, 0.16, 0.25),
            bag=bool(rng.random() < 0.4), walks=walks,
            hair=shade(HAIR, rng.uniform(0.4, 5.0)), skin=shade(SKIN, rng.uniform(0.35, 1.1)),
            phase=float(rng.random()),
        )  # fmt: skip

    @property
    def stride(self) -> float:
        """Metres per walking cycle of two steps."""
        return STRIDE * self.height

    @cached_property
    def pieces(self) -> tuple[ColoredMesh, ...]:
        clothing = Clothing(self.shirt, self.trousers, self.hair, self.skin, SHOES, skirt=0.2)
        pieces = human_pieces(self.height, clothing)
        if self.bag:
            body = box((-0.09, -0.03, -0.22), (0.09, 0.03, -0.06), Material.CLOTH, BAG)
            straps = [
                cylinder((0.0, 0.0, 0.0), (x, y, -0.07), 0.004, Material.CLOTH, BAG)
                for x in (-0.05, 0.05)
                for y in (-0.02, 0.02)
            ]
            pieces = (*pieces, in_metres(concatenate([body, *straps]), self.height))
        return tuple(piece.classified(SurfaceClass.PERSON) for piece in pieces)

    @cached_property
    def size(self) -> np.ndarray:
        """Standing height; mean length and width over a cycle (`mean_size`)."""
        cycle = np.arange(24) / 24
        length, width, _ = mean_size(self.poses(self.stride * cycle, GESTURE_SECONDS * cycle), self.pieces)
        return np.array([length, width, self.height])

    def poses(self, distance: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        cycles, idle_seconds = distance / self.stride + self.phase, seconds + 7.0 * GESTURE_SECONDS * self.phase
        posture = walking(cycles, BAG_ARM_SWING if self.bag else 1.0) if self.walks else standing(idle_seconds)
        poses = human_poses(posture, self.height)
        if not self.bag:
            return poses
        forearm = poses[:, HUMAN_PIECES.index("left forearm")]
        hand = placed(forearm, self.height * HAND_OF_BAG)[:, 0]
        # the bag tilts less than the arm that holds it
        bag = oriented(hand, 0.0, 0.4 * np.arctan2(forearm[:, 0, 2], forearm[:, 2, 2]))
        return np.concatenate([poses, bag[:, None]], axis=1)


def drawn_color(rng: np.random.Generator, low: float, high: float, saturation: float = 0.5) -> Color:
    """A random colour of a brightness between `low` and `high`."""
    red, green, blue = rng.uniform(1.0 - saturation, 1.0 + saturation, 3) * rng.uniform(low, high)
    return shade((red, green, blue), 1.0)


def shade(color: Color, factor: float) -> Color:
    """A colour brightened by a factor, clipped to what surfaces reflect."""
    red, green, blue = (float(value) for value in np.clip(factor * np.array(color), 0.01, 0.9))
    return red, green, blue
