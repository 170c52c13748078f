"""People who ride a bicycle."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drivesplat.world.shapes.bicycle import (
    AXLES,
    BOTTOM_BRACKET,
    CANVAS,
    CRANK_LENGTH,
    GEAR_RATIO,
    SEAT_ANGLE,
    WHEEL_RADIUS,
    BicycleFrame,
    crank,
    frame_mesh,
    pedal,
    pedals,
    wheel,
)  # fmt: skip
from drivesplat.world.shapes.human import (
    ARM_PIECES,
    BALL,
    FOREARM,
    HIPS,
    HUMAN_PIECES,
    LEG_PIECES,
    NECK,
    SHIN,
    SHOULDERS,
    THIGH,
    UPPER_ARM,
    WAIST,
    Clothing,
    Posture,
    head,
    human_pieces,
    human_poses,
    in_metres,
)  # fmt: skip
from drivesplat.world.shapes.limbs import loft, mean_size, oriented, pitched, placed, two_link
from drivesplat.world.shapes.mesh import SKIN, Color, ColoredMesh, Material, SurfaceClass, box, concatenate
from drivesplat.world.shapes.people import HAIR, MAX_HEIGHT, MIN_HEIGHT, SHOES, drawn_color, shade

CYCLIST_PIECES = ("frame", "front wheel", "rear wheel", "crank", "rider", "head", *LEG_PIECES)
"""The order of a cyclist's pieces. The rider's piece is the upper body, in the object's frame; each foot's has its
pedal."""
SEAT_TO_BOTTOM_BRACKET = 0.44
"""Distance between hips and bottom bracket in body heights."""
SOLE_ABOVE_PEDAL = 0.012
FOOT_PITCH, ANKLING = 0.28, 0.12
"""Mean pitch of the feet and its amplitude over a turn of the crank: behind the crank, the toes point down."""
PELVIS_PITCH, TORSO_PITCH, HEAD_PITCH = 0.3, 0.58, 0.12
WRIST = np.array([0.2, 0.0, 0.6])
"""Wrists ahead of the shoulders and above the ground, in body heights."""


@dataclass(frozen=True)
class Cyclist:
    """A person who rides a bicycle. Pieces are those of `CYCLIST_PIECES`. `height` is the standing person's (metres);
    `luggage`: a backpack, panniers and a basket; `phase`: the turns by which the crank is ahead."""

    height: float
    shirt: Color
    trousers: Color
    bicycle: Color
    helmet: Color
    luggage: bool = True
    hair: Color = HAIR
    skin: Color = SKIN
    phase: float = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Cyclist":
        """A cyclist with random height, colours and phase, and with luggage."""
        return cls(
            height=float(np.clip(rng.normal(1.74, 0.08), MIN_HEIGHT, MAX_HEIGHT)),
            shirt=drawn_color(rng, 0.04, 0.5), trousers=drawn_color(rng, 0.03, 0.16, 0.25),
            bicycle=drawn_color(rng, 0.03, 0.4), helmet=drawn_color(rng, 0.05, 0.7),
            hair=shade(HAIR, rng.uniform(0.4, 5.0)), skin=shade(SKIN, rng.uniform(0.35, 1.1)),
            phase=float(rng.random()),
        )  # fmt: skip

    @cached_property
    def pieces(self) -> tuple[ColoredMesh, ...]:
        clothing = Clothing(self.shirt, self.trousers, self.hair, self.skin, SHOES, skirt=0.0)
        human = dict(zip(HUMAN_PIECES, human_pieces(self.height, clothing), strict=True))
        resting = human_poses(self._posture(np.zeros(1), np.zeros(1)), self.height)[0]
        poses = dict(zip(HUMAN_PIECES, resting, strict=True))
        if self.luggage:
            backpack = box((-0.24, -0.11, 0.0), (-0.06, 0.11, 0.25), Material.CLOTH, CANVAS)
            human["torso"] = concatenate([human["torso"], in_metres(backpack, self.height)])
        upper = [human[name].transformed(poses[name]) for name in ("pelvis", "torso", *ARM_PIECES)]
        tread = pedal().moved((self.height * BALL[0], 0.0, self.height * BALL[1]))
        for name in ("left foot", "right foot"):
            human[name] = concatenate([human[name], tread])
        helmet = [
            (0.108, -0.012, 0.064, 0.052), (0.13, -0.002, 0.073, 0.056), (0.155, -0.002, 0.066, 0.05),
            (0.178, -0.004, 0.045, 0.034), (0.186, -0.004, 0.015, 0.012),
        ]  # fmt: skip
        helmeted = concatenate([head(self.skin, self.hair), loft(helmet, Material.PLAIN, self.helmet)])
        pieces = [
            frame_mesh(self._frame, self.bicycle, self.luggage), wheel(), wheel(), crank(), concatenate(upper),
            in_metres(helmeted, self.height), *(human[name] for name in LEG_PIECES),
        ]  # fmt: skip
        return tuple(piece.classified(SurfaceClass.CYCLIST) for piece in pieces)

    @cached_property
    def size(self) -> np.ndarray:
        """Greatest height; mean length and width over a turn of the crank (`mean_size`)."""
        cycle = np.arange(16) / 16
        turn = 2.0 * np.pi * WHEEL_RADIUS * GEAR_RATIO
        return mean_size(self.poses(turn * cycle, 10.0 * cycle), self.pieces, share=0.95)

    def poses(self, distance: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        wheel_angle = distance / WHEEL_RADIUS
        crank_angle = wheel_angle / GEAR_RATIO + 2.0 * np.pi * self.phase
        n = len(distance)
        fixed = np.broadcast_to(np.eye(4), (n, 4, 4))
        wheels = [oriented(np.tile(axle, (n, 1)), pitch=wheel_angle) for axle in AXLES]
        turning = oriented(np.tile(BOTTOM_BRACKET, (n, 1)), pitch=crank_angle)
        human = human_poses(self._posture(crank_angle, seconds), self.height)
        moving = human[:, [HUMAN_PIECES.index(name) for name in ("head", *LEG_PIECES)]]
        return np.concatenate([np.stack([fixed, *wheels, turning, fixed], axis=1), moving], axis=1)

    @property
    def _hip(self) -> np.ndarray:
        """Centre of the hip joints (3,), metres."""
        along = np.array([-np.cos(SEAT_ANGLE), 0.0, np.sin(SEAT_ANGLE)])
        return BOTTOM_BRACKET + SEAT_TO_BOTTOM_BRACKET * self.height * along

    @property
    def _frame(self) -> BicycleFrame:
        """The frame that fits the rider."""
        wrist = self.height * self._posture(np.zeros(1), np.zeros(1)).wrists[0, 0]
        return BicycleFrame(np.subtract(self._hip, (0.02, 0.0, 0.05 * self.height)), np.add(wrist, (0.05, 0.0, -0.035)))

    def _posture(self, crank_angle: np.ndarray, seconds: np.ndarray) -> Posture:
        """Postures (n) in body heights: the upper body rests, the head looks around, the feet follow the pedals."""
        n = len(crank_angle)
        pelvis = oriented(np.tile(self._hip / self.height, (n, 1)), pitch=PELVIS_PITCH)
        torso = oriented(placed(pelvis, WAIST)[:, 0], pitch=TORSO_PITCH)
        look = 0.3 * np.sin(2.0 * np.pi * seconds / 6.7)
        neck = oriented(placed(torso, NECK)[:, 0], look, HEAD_PITCH)
        shoulders = placed(torso, SHOULDERS)
        wrists = shoulders * (1.0, 0.0, 0.0) + WRIST + np.array([[0.0, 0.145, 0.0], [0.0, -0.145, 0.0]])
        elbow_bend = np.array([[-0.3, 0.5, -0.8], [-0.3, -0.5, -0.8]])
        elbows = two_link(shoulders, wrists, (UPPER_ARM, FOREARM), elbow_bend)
        centers = pedals(crank_angle) + np.array([0.0, 0.0, SOLE_ABOVE_PEDAL])
        pitch = FOOT_PITCH - ANKLING * (centers[..., 0] - BOTTOM_BRACKET[0]) / CRANK_LENGTH
        x, z = np.moveaxis(pitched(np.array(BALL), pitch), -1, 0)
        ankles, pitch = centers / self.height - np.stack([x, np.zeros_like(x), z], axis=-1), pitch
        knees = two_link(placed(pelvis, HIPS), ankles, (THIGH, SHIN), np.array([1.0, 0.0, 0.0]))
        return Posture(pelvis, torso, neck, elbows, wrists, knees, ankles, pitch)
