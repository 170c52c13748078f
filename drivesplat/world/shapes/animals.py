"""Dogs. Proportions are in heights at the withers."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drivesplat.world.shapes.human import in_metres
from drivesplat.world.shapes.limbs import limb, links, loft, mean_size, oriented, placed, two_link
from drivesplat.world.shapes.mesh import (
    Color,
    ColoredMesh,
    Material,
    SurfaceClass,
    concatenate,
    ellipsoid,
    symmetric_hull,
)
from drivesplat.world.shapes.people import shade

STRIDE = 1.1
"""Length of a cycle: 2.3 F^0.3 hip heights by Alexander, Nature 261 (1976), with F = speed^2 / (g hip height); here
F = 0.3 and the hips are at 0.7."""
LEGS = ("left front", "right front", "left hind", "right hind")
DOG_PIECES = ("body", "head", "tail", *(f"{leg} {part}" for part in ("upper leg", "lower leg", "paw") for leg in LEGS))
"""The order of a dog's pieces. The origin of each leg's piece is its upper joint."""
LEG_PHASES = np.array([0.0, 0.5, 0.5, 0.0])
"""Diagonal pairs of a trot move together."""
BODY_HEIGHT, STANDING_RISE, PAW_HEIGHT = 0.715, 0.055, 0.05
FRONT_LEG, HIND_LEG = (0.3, 0.36), (0.45, 0.3)
"""Lengths of the upper and the lower links."""
LEG_ROOTS = np.array([[0.34, 0.1, -0.11], [0.34, -0.1, -0.11], [-0.36, 0.1, 0.0], [-0.36, -0.1, 0.0]])
NECK, TAIL_ROOT = np.array([[0.4, 0.0, 0.1]]), np.array([[-0.5, 0.0, 0.1]])
"""In the body's frame."""
STEP_LENGTH, LIFT, SWING_PITCH = STRIDE / 2, 0.12, 0.7
DARK, COLLAR, FUR = (0.02, 0.018, 0.016), (0.5, 0.04, 0.03), (0.3, 0.18, 0.08)


@dataclass(frozen=True)
class Dog:
    """A dog. Pieces are those of `DOG_PIECES`. `height` at the withers in metres; `walks`: it trots, else stands;
    `phase`: the share of a cycle by which the motion is ahead."""

    height: float
    fur: Color = FUR
    walks: bool = True
    phase: float = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator, walks: bool = True) -> "Dog":
        """A dog with random height, colour and phase."""
        return cls(float(rng.uniform(0.48, 0.65)), shade(FUR, rng.uniform(0.1, 2.2)), walks, float(rng.random()))

    @property
    def stride(self) -> float:
        """Metres per cycle."""
        return STRIDE * self.height

    @cached_property
    def pieces(self) -> tuple[ColoredMesh, ...]:
        fur, plain = self.fur, Material.PLAIN
        uppers = [
            limb(FRONT_LEG[0], (0.1, 0.09, 0.065), plain, fur),
            limb(HIND_LEG[0], (0.11, 0.135, 0.09, 0.055), plain, fur),
        ]
        lowers = [
            limb(FRONT_LEG[1], (0.065, 0.05, 0.046), plain, fur),
            limb(HIND_LEG[1], (0.055, 0.046, 0.046), plain, fur),
        ]
        links_of_legs = [group[i] for group in (uppers, lowers) for i in (0, 0, 1, 1)]
        # the head, with its origin at the neck's base: neck, collar, skull with muzzle, nose, ears
        neck = limb(0.34, (0.15, 0.13, 0.11), Material.PLAIN, fur)
        collar = loft([(-0.2, 0.0, 0.137, 0.137), (-0.24, 0.0, 0.133, 0.133)], Material.CLOTH, COLLAR)
        up = oriented(np.zeros((1, 3)), pitch=np.radians(180.0 + 40.0))[0]
        skull = [
            (-0.1, 0.0, 0.06, 0.06), (-0.04, -0.01, 0.115, 0.11), (0.05, -0.01, 0.12, 0.115), (0.11, 0.02, 0.09, 0.085),
            (0.15, 0.04, 0.072, 0.065), (0.24, 0.045, 0.066, 0.056), (0.28, 0.045, 0.04, 0.04),
        ]  # fmt: skip
        center = np.array([0.25, 0.0, 0.3])
        parts = [neck.transformed(up), collar.transformed(up)]
        parts.append(loft(skull, Material.PLAIN, fur).transformed(_LAID_DOWN).moved(center))
        parts.append(ellipsoid(np.add(center, (0.275, 0.0, -0.012)), (0.024, 0.027, 0.022), Material.PLAIN, DARK))
        flap = [(-0.05, 0.08, 0.015), (0.04, 0.08, 0.015), (-0.05, -0.09, 0.012), (0.03, -0.1, 0.012)]
        ear = symmetric_hull(flap, Material.PLAIN, shade(fur, 0.5))
        trunk = [
            (-0.54, -0.06, 0.08, 0.07), (-0.47, -0.05, 0.16, 0.13), (-0.3, -0.03, 0.19, 0.16),
            (-0.05, 0.0, 0.205, 0.165), (0.2, 0.01, 0.25, 0.18), (0.36, -0.02, 0.24, 0.165),
            (0.46, -0.06, 0.17, 0.13), (0.52, -0.08, 0.09, 0.08),
        ]  # fmt: skip
        pieces = [
            loft(trunk, plain, fur, 12).transformed(_LAID_DOWN),
            concatenate([*parts, *(ear.moved(np.add(center, (-0.02, side * 0.11, 0.01))) for side in (-1, 1))]),
            limb(0.36, (0.05, 0.06, 0.05, 0.025), plain, fur),
            *links_of_legs,
        ]
        profile = [
            (-0.045, -PAW_HEIGHT, 0.035), (0.065, -PAW_HEIGHT, 0.045), (0.08, -0.02, 0.035), (0.03, 0.03, 0.035),
            (-0.05, 0.01, 0.03),
        ]  # fmt: skip
        pieces += [symmetric_hull(profile, Material.PLAIN, fur)] * 4
        return tuple(in_metres(piece, self.height).classified(SurfaceClass.ANIMAL) for piece in pieces)

    @cached_property
    def size(self) -> np.ndarray:
        """Greatest height; mean length and width over a cycle (`mean_size`)."""
        cycle = np.arange(16) / 16
        return mean_size(self.poses(self.stride * cycle, cycle), self.pieces)

    def poses(self, distance: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        n, seconds = len(seconds), seconds + 10.0 * self.phase
        cycles = distance / self.stride + self.phase
        bob = 0.012 * np.cos(4.0 * np.pi * cycles) if self.walks else 0.004 * np.sin(2.0 * np.pi * seconds / 2.5)
        height = BODY_HEIGHT + bob + (0.0 if self.walks else STANDING_RISE)
        body = oriented(np.stack([np.zeros(n), np.zeros(n), height], axis=-1))
        look = 0.0 if self.walks else 0.5 * np.sin(2.0 * np.pi * seconds / 6.1)
        head = oriented(placed(body, NECK)[:, 0], look, 2.0 * bob)
        tail = oriented(placed(body, TAIL_ROOT)[:, 0], 0.5 * np.sin(2.0 * np.pi * 1.8 * seconds), 2.0)
        x, lift, pitch = trot(cycles[:, None] + LEG_PHASES) if self.walks else np.zeros((3, len(cycles), 4))
        y = np.broadcast_to(0.9 * LEG_ROOTS[:, 1], x.shape)
        paws = np.stack([LEG_ROOTS[:, 0] + x, y, PAW_HEIGHT + lift], axis=-1)
        roots = placed(body, LEG_ROOTS)
        backward, left = np.array([-1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
        pairs = ((slice(0, 2), FRONT_LEG), (slice(2, 4), HIND_LEG))
        joints = np.concatenate([two_link(roots[:, i], paws[:, i], lengths, backward) for i, lengths in pairs], axis=1)
        feet = np.stack([oriented(paws[:, i], pitch=pitch[:, i]) for i in range(4)], axis=1)
        trunk = np.stack([body, head, tail], axis=1)
        poses = np.concatenate([trunk, links(roots, joints, left), links(joints, paws, left), feet], axis=1)
        poses[..., :3, 3] *= self.height
        return poses


def trot(phases: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far a paw is ahead of its neutral place, its lift and its pitch at `phases` (...) in cycles since it landed.

    It rests on the ground for half of the cycle; a cubic polynomial that continues its velocity swings it forward.
    """
    phases = phases % 1.0
    swing = np.clip(2.0 * phases - 1.0, 0.0, 1.0)
    forward = STEP_LENGTH * (swing**2 * (3.0 - 2.0 * swing) - 0.5)
    slowing = -STEP_LENGTH * (swing * (1.0 - swing) ** 2 - swing**2 * (1.0 - swing))
    stance = STEP_LENGTH / 2 - STRIDE * phases
    arc = np.sin(np.pi * swing) ** 2
    return np.where(phases < 0.5, stance, forward + slowing), LIFT * arc, SWING_PITCH * arc


_LAID_DOWN = oriented(np.zeros((1, 3)), pitch=np.pi / 2)[0]
"""What is built along z, laid down: -x becomes up."""
