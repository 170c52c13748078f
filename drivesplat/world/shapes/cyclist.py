"""People who ride a bicycle. The middle of the wheelbase is at x = 0, the ground at z = 0, in metres."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

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
from drivesplat.world.shapes.mesh import (
    METAL,
    SKIN,
    TYRE,
    Color,
    ColoredMesh,
    Material,
    SurfaceClass,
    box,
    concatenate,
    cylinder,
    symmetric_hull,
    torus,
)  # fmt: skip
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
WHEEL_RADIUS, WHEELBASE, CRANK_LENGTH = 0.34, 1.08, 0.17
GEAR_RATIO = 2.5
"""Turns of the rear wheel per turn of the crank."""
AXLES = np.array([[WHEELBASE / 2, 0.0, WHEEL_RADIUS], [-WHEELBASE / 2, 0.0, WHEEL_RADIUS]])
"""Front, rear."""
BOTTOM_BRACKET = np.array([-0.09, 0.0, 0.285])
PEDAL_OFFSET = 0.12
"""Distance of the pedals' centres from the plane of the frame."""
SEAT_ANGLE, STEERING_ANGLE = np.radians(72.0), np.radians(70.0)
LEATHER, CANVAS = (0.05, 0.04, 0.035), (0.12, 0.12, 0.06)
SPOKES = 12


@dataclass(frozen=True)
class BicycleFrame:
    """A frame by the positions (3,) of its saddle and of its left grip."""

    saddle: np.ndarray
    grip: np.ndarray

    @property
    def head(self) -> np.ndarray:
        """The upper end of the steering tube."""
        height = self.grip[2] - 0.13
        return np.array([AXLES[0, 0] - (height - WHEEL_RADIUS) / np.tan(STEERING_ANGLE), 0.0, height])


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


def frame_mesh(frame: BicycleFrame, color: Color, luggage: bool) -> ColoredMesh:
    """Everything of a bicycle that does not turn; `luggage`: with panniers and a basket."""
    front, rear = AXLES
    lug = BOTTOM_BRACKET + 0.68 * (frame.saddle - BOTTOM_BRACKET)
    crown = frame.head + 0.33 * (front - frame.head)
    mains = [(BOTTOM_BRACKET, lug, 0.02), (lug, frame.head + 0.1 * (front - frame.head), 0.018),
             (BOTTOM_BRACKET, crown, 0.022), (frame.head, crown, 0.024), (lug, frame.saddle, 0.014)]  # fmt: skip
    aside = np.array([0.0, 0.06, 0.0])
    stays = [
        (joint, axle + side * aside, 0.011)
        for side in (-1, 1)
        for joint, axle in ((BOTTOM_BRACKET, rear), (lug, rear), (crown + 0.8 * side * aside, front))
    ]
    parts = [cylinder(start, end, radius, Material.METAL, color) for start, end, radius in [*mains, *stays]]
    axis = (frame.head - AXLES[0]) / np.linalg.norm(frame.head - AXLES[0])
    top = frame.head + 0.13 * axis
    parts.append(cylinder(frame.head, top, 0.014, Material.METAL, METAL))
    for side, grip in ((1, frame.grip), (-1, frame.grip * (1.0, -1.0, 1.0))):
        bend = top + np.array([0.0, side * 0.2, 0.02])
        parts.append(cylinder(top, bend, 0.012, Material.METAL, METAL))
        parts.append(cylinder(bend, grip, 0.016, Material.PLAIN, TYRE))
    shape = [(-0.13, 0.0, 0.08), (-0.13, 0.03, 0.07), (-0.05, -0.05, 0.05), (0.14, 0.02, 0.018), (0.14, -0.02, 0.015)]
    parts.append(symmetric_hull(shape, Material.PLAIN, LEATHER).moved(frame.saddle))
    # mudguards: arcs of plates above the wheels
    plate = box((-0.07, -0.03, WHEEL_RADIUS + 0.015), (0.075, 0.03, WHEEL_RADIUS + 0.022), Material.METAL, color)
    for axle, degrees in ((front, np.arange(-65.0, 40.0, 20.0)), (rear, np.arange(-105.0, 60.0, 20.0))):
        poses = oriented(np.tile(axle, (len(degrees), 1)), pitch=np.radians(degrees))
        parts += [plate.transformed(pose) for pose in poses]
    y = -0.052  # of the chain case
    inner, outer = np.array([0.0, y, 0.0]), np.array([0.0, y - 0.012, 0.0])
    for center, radius in ((BOTTOM_BRACKET, 0.105), (rear, 0.055)):
        parts.append(cylinder(center + outer, center + inner, radius, Material.METAL, color))
    low = (rear[0], y - 0.012, WHEEL_RADIUS - 0.05)
    parts.append(box(low, (BOTTOM_BRACKET[0], y, WHEEL_RADIUS + 0.045), Material.METAL, color))
    if luggage:  # panniers beside the rear wheel, a basket in front of the handlebar
        x, deck = rear[0], 2 * WHEEL_RADIUS + 0.04
        parts.append(box((x - 0.22, -0.06, deck), (x + 0.2, 0.06, deck + 0.02), Material.METAL, METAL))
        for low, high in ((0.07, 0.19), (-0.19, -0.07)):
            parts.append(box((x - 0.22, low, deck - 0.36), (x + 0.16, high, deck + 0.01), Material.CLOTH, CANVAS))
        x = frame.head[0] + 0.07
        parts.append(box((x, -0.18, deck + 0.06), (x + 0.28, 0.18, deck + 0.32), Material.CLOTH, CANVAS))
    return concatenate(parts)


def wheel() -> ColoredMesh:
    """A wheel with its axle at the origin."""
    rim = WHEEL_RADIUS - 0.022
    spoke = box((-0.003, -0.003, 0.0), (0.003, 0.003, rim), Material.METAL, METAL)
    angles = 2.0 * np.pi * np.arange(SPOKES) / SPOKES
    spokes = [spoke.transformed(pose) for pose in oriented(np.zeros((SPOKES, 3)), pitch=angles)]
    hub = cylinder((0, -0.05, 0), (0, 0.05, 0), 0.025, Material.METAL, METAL)
    return concatenate([torus((0, 0, 0), rim, 0.022, Material.PLAIN, TYRE), hub, *spokes])


def crank() -> ColoredMesh:
    """The crank with its axle at the origin, the left arm along x."""
    y = PEDAL_OFFSET - 0.05
    arms = [
        box((0.0, y - 0.008, -0.012), (CRANK_LENGTH, y + 0.008, 0.012), Material.METAL, METAL),
        box((-CRANK_LENGTH, -y - 0.008, -0.012), (0.0, -y + 0.008, 0.012), Material.METAL, METAL),
    ]
    chainring = cylinder((0, -0.05, 0), (0, -0.045, 0), 0.09, Material.METAL, METAL)
    return concatenate([*arms, chainring, cylinder((0, -y, 0), (0, y, 0), 0.015, Material.METAL, METAL)])


def pedal() -> ColoredMesh:
    """A pedal, whose upper surface has its centre at the origin."""
    return box((-0.045, -0.045, -0.024), (0.045, 0.045, 0.0), Material.METAL, TYRE)


def pedals(crank_angle: np.ndarray) -> np.ndarray:
    """Positions (n, 2, 3) of the pedals at angles (n,) of the crank, left first."""
    angles = np.stack([crank_angle, crank_angle + np.pi], axis=-1)
    y = np.broadcast_to(PEDAL_OFFSET * np.array([1.0, -1.0]), angles.shape)
    circle = np.stack([CRANK_LENGTH * np.cos(angles), y, -CRANK_LENGTH * np.sin(angles)], axis=-1)
    return BOTTOM_BRACKET + circle
