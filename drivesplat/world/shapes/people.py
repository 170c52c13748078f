"""People who walk or stand. Postures are in body heights."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from drivesplat.world.shapes.human import (
    BALL,
    FOREARM,
    HEEL,
    HIP,
    HIPS,
    HUMAN_PIECES,
    NECK,
    SHIN,
    SHOULDERS,
    THIGH,
    TOE,
    UPPER_ARM,
    WAIST,
    Clothing,
    Posture,
    human_pieces,
    human_poses,
    in_metres,
)  # fmt: skip
from drivesplat.world.shapes.limbs import mean_size, oriented, pitched, placed, two_link
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
STRIDE = 0.83
"""Length of a walking cycle (two steps): pedometers take 0.413 to 0.415 body heights for a step."""
STANCE = 0.6
"""Share of the cycle in which a foot is on the ground (Perry, Gait Analysis, 1992)."""
LANDING = 0.216
"""Where the ankle would be ahead of the hips, were the landing foot flat."""
PITCH_KEYS = ((0.0, -20.0), (0.08, 0.0), (0.34, 0.0), (STANCE, 48.0), (0.7, 45.0), (0.83, 5.0), (0.93, -20.0))
"""Pitch of the foot over the cycle, in degrees, positive with the toes down."""
GESTURE_SECONDS = 11.0
"""Period of a standing person's gesture."""
SIDES = np.array([1.0, -1.0])
"""Left, right."""


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


def walking(cycles: np.ndarray, left_arm_swing: float = 1.0) -> Posture:
    """Postures at `cycles` (n,) walking cycles; at 0, the left heel lands. An arm with a load swings less."""
    phases = np.stack([cycles, cycles + 0.5], axis=-1)
    # the ankles in the body's frame and the pitches of the feet, by the cycles since the heel landed
    landed = phases % 1.0
    swing_x, swing_z = np.moveaxis(_swing()(np.maximum(landed, STANCE)), -1, 0)
    stance_x, stance_z = np.moveaxis(_stance(np.minimum(landed, STANCE)), -1, 0)
    x, z = np.where(landed < STANCE, stance_x, swing_x), np.where(landed < STANCE, stance_z, swing_z)
    ankles = np.stack([x, np.broadcast_to(0.042 * SIDES, x.shape), z], axis=-1)
    turning, bobbing = 2.0 * np.pi * cycles, 4.0 * np.pi * (cycles - 0.26)
    pelvis = np.stack([np.zeros_like(cycles), 0.01 * np.sin(turning), HIP - 0.025 + 0.011 * np.cos(bobbing)], axis=-1)
    swing = -np.cos(2.0 * np.pi * phases)
    free = np.array([left_arm_swing, 1.0])
    turn = np.cos(turning)
    return _posture(
        pelvis, ankles, _pitch()(landed),
        pelvis_turn=-0.08 * turn, torso_turn=0.06 * turn, lean=np.full_like(cycles, 0.05), look=np.zeros_like(cycles),
        arm_swing=0.04 + 0.34 * free * swing, elbow_flexion=free * (0.3 + 0.16 * swing),
    )  # fmt: skip


def standing(seconds: np.ndarray) -> Posture:
    """Postures at `seconds` (n,): the weight shifts between the legs, the right arm gestures."""
    shift = np.sin(2.0 * np.pi * seconds / 7.3)
    n = len(seconds)
    ankles = np.broadcast_to([[0.01, 0.055, HIP - THIGH - SHIN], [-0.012, -0.06, HIP - THIGH - SHIN]], (n, 2, 3))
    pelvis = np.stack([np.zeros(n), 0.018 * shift, HIP - 0.004 - 0.003 * np.abs(shift)], axis=-1)
    gesture = 0.5 - 0.5 * np.cos(2.0 * np.pi * seconds / GESTURE_SECONDS)
    wave = gesture * np.sin(2.0 * np.pi * seconds / 1.9)
    return _posture(
        pelvis, ankles, np.zeros((n, 2)),
        pelvis_turn=0.05 * shift, torso_turn=-0.04 * shift, lean=np.full(n, 0.02),
        look=0.35 * np.sin(2.0 * np.pi * seconds / 9.1),
        arm_swing=np.stack([0.04 + 0.02 * shift, 0.05 + 0.2 * gesture + 0.06 * wave], axis=-1),
        elbow_flexion=np.stack([0.2 + 0.03 * shift, 0.25 + 1.0 * gesture + 0.25 * wave], axis=-1),
    )  # fmt: skip


def _stance(phases: np.ndarray) -> np.ndarray:
    """The ankle's x and z (..., 2) while its foot rolls over heel, sole, ball and toe without sliding."""
    pitch = _pitch()(phases)
    edge = np.arctan2(TOE[1] - BALL[1], TOE[0] - BALL[0])
    rolled = np.where(
        (pitch < 0.0)[..., None],
        HEEL + pitched(np.negative(HEEL), pitch),
        BALL + pitched(np.subtract(TOE, BALL), np.minimum(pitch, edge)) + pitched(np.negative(TOE), pitch),
    )
    ground = np.stack([LANDING - STRIDE * phases, np.full_like(phases, HIP - THIGH - SHIN)], axis=-1)
    return ground + rolled


@cache
def _pitch() -> PchipInterpolator:
    phases, degrees = np.array(PITCH_KEYS).T
    times = np.concatenate([phases - 1.0, phases, phases + 1.0])
    return PchipInterpolator(times, np.radians(np.tile(degrees, 3)))


@cache
def _swing() -> CubicSpline:
    """The ankle's x and z over the phases of the swing; position and velocity continue those of the stance, except that
    the heel descends when it lands."""
    step = 1e-5
    ends = _stance(np.array([STANCE - step, STANCE, 0.0, step]))
    middle = np.array([[0.0, 0.105], [0.155, 0.068]])
    landing = (ends[3] - ends[2]) / step - np.array([0.0, 0.5])
    return CubicSpline(
        [STANCE, 0.78, 0.9, 1.0], [ends[1], *middle, ends[2]], bc_type=((1, (ends[1] - ends[0]) / step), (1, landing))
    )


def _posture(
    pelvis: np.ndarray, ankles: np.ndarray, foot_pitch: np.ndarray, *, pelvis_turn: np.ndarray, torso_turn: np.ndarray,
    lean: np.ndarray, look: np.ndarray, arm_swing: np.ndarray, elbow_flexion: np.ndarray,
) -> Posture:  # fmt: skip
    """The posture of a body upright on two feet."""
    pelvis_pose = oriented(pelvis, pelvis_turn)
    torso = oriented(placed(pelvis_pose, WAIST)[:, 0], torso_turn, lean)
    head = oriented(placed(torso, NECK)[:, 0], look)
    elbows = placed(torso, SHOULDERS) + UPPER_ARM * _arm_direction(torso, arm_swing, 0.1)
    wrists = elbows + FOREARM * _arm_direction(torso, arm_swing + elbow_flexion, 0.0)
    knees = two_link(placed(pelvis_pose, HIPS), ankles, (THIGH, SHIN), pelvis_pose[:, None, :3, 0])
    return Posture(pelvis_pose, torso, head, elbows, wrists, knees, ankles, foot_pitch)


def _arm_direction(torso: np.ndarray, forward: np.ndarray, outward: float) -> np.ndarray:
    """Unit vectors (n, 2, 3) of arms raised forward (n, 2) and outward by angles, from hanging."""
    hanging = np.cos(forward)
    local = np.stack([np.sin(forward), np.sin(outward) * SIDES * hanging, -np.cos(outward) * hanging], axis=-1)
    return np.einsum("nij,nkj->nki", torso[:, :3, :3], local)
