"""The human figure: proportions, pieces and the poses of a posture.

Segment lengths are fractions of the body height by Drillis and Contini (1966), as Winter, Biomechanics and Motor
Control of Human Movement, figure 4.1, gives them. Postures are in body heights, meshes in metres.
"""

from dataclasses import dataclass, replace

import numpy as np

from drivesplat.world.shapes.limbs import Ring, limb, links, loft, oriented, placed
from drivesplat.world.shapes.mesh import Color, ColoredMesh, Material, concatenate, hull, symmetric_hull

THIGH, SHIN, ANKLE, UPPER_ARM, FOREARM = 0.245, 0.246, 0.039, 0.186, 0.146
HIP = THIGH + SHIN + ANKLE
HIPS = np.array([[0.0, 0.05, 0.0], [0.0, -0.05, 0.0]])
"""Hip joints in the pelvis's frame, left first."""
WAIST = np.array([[0.0, 0.0, 0.05]])
"""The torso's origin in the pelvis's frame."""
SHOULDERS = np.array([[0.0, 0.107, 0.225], [0.0, -0.107, 0.225]])
NECK = np.array([[0.0, 0.0, 0.245]])
"""In the torso's frame."""
HEEL, BALL, TOE = (-0.04, -ANKLE), (0.068, -ANKLE), (0.108, 0.014 - ANKLE)
"""Corners of the sole relative to the ankle: x and z."""
LEG_PIECES = ("left thigh", "right thigh", "left shin", "right shin", "left foot", "right foot")
ARM_PIECES = ("left upper arm", "right upper arm", "left forearm", "right forearm")
HUMAN_PIECES = ("pelvis", "torso", "head", *ARM_PIECES, *LEG_PIECES)
"""The order of a human's pieces. The origin of each is its upper joint; the head's is the base of the neck."""


@dataclass(frozen=True)
class Clothing:
    """Colours, and the length of the coat below the hip joints in body heights."""

    coat: Color
    trousers: Color
    hair: Color
    skin: Color
    shoes: Color
    skirt: float


@dataclass(frozen=True)
class Posture:
    """Joints at n times in body heights: poses of `pelvis`, `torso`, `head` (n, 4, 4), positions of `elbows`, `wrists`,
    `knees`, `ankles` (n, 2, 3), left first, and `foot_pitch` (n, 2) in radians, positive with the toes down."""

    pelvis: np.ndarray
    torso: np.ndarray
    head: np.ndarray
    elbows: np.ndarray
    wrists: np.ndarray
    knees: np.ndarray
    ankles: np.ndarray
    foot_pitch: np.ndarray


def in_metres(mesh: ColoredMesh, height: float) -> ColoredMesh:
    """A mesh in body heights scaled to metres together with its texture."""
    scaled = mesh.scaled(height)
    return replace(scaled, texture=scaled.vertices)


def human_pieces(height: float, clothing: Clothing) -> tuple[ColoredMesh, ...]:
    """The pieces of `HUMAN_PIECES`, in metres."""
    cloth = Material.CLOTH
    upper_arm = limb(UPPER_ARM, (0.034, 0.037, 0.034, 0.031), cloth, clothing.coat)
    sleeve = limb(FOREARM, (0.031, 0.03, 0.026), cloth, clothing.coat)
    thigh = limb(THIGH, (0.05, 0.055, 0.05, 0.046), cloth, clothing.trousers)
    shin = limb(SHIN - 0.005, (0.045, 0.047, 0.042, 0.04), cloth, clothing.trousers)
    if clothing.skirt > 0.0:
        tail = [  # the half of the coat's skirt that moves with a thigh
            (0.02, 0.0, 0.05, 0.04), (-0.01, 0.0, 0.074, 0.055), (-0.6 * clothing.skirt, 0.0, 0.082, 0.064),
            (-clothing.skirt, 0.0, 0.086, 0.068),
        ]  # fmt: skip
        thigh = concatenate([thigh, loft(tail, cloth, clothing.coat)])
    hand = [
        (-FOREARM + 0.01, 0.0, 0.018, 0.014), (-FOREARM - 0.03, 0.004, 0.025, 0.013),
        (-FOREARM - 0.065, 0.01, 0.021, 0.013), (-FOREARM - 0.09, 0.013, 0.01, 0.009),
    ]  # fmt: skip
    forearm = concatenate([sleeve, loft(hand, Material.PLAIN, clothing.skin, 8)])
    profile = [
        (*HEEL, 0.02), (*BALL, 0.029), (*TOE, 0.016), (0.1, 0.03 - ANKLE, 0.018), (0.06, 0.042 - ANKLE, 0.024),
        (0.02, 0.03, 0.022), (-0.03, 0.03, 0.02), (-0.046, 0.03 - ANKLE, 0.018),
    ]  # fmt: skip
    foot = symmetric_hull(profile, Material.PLAIN, clothing.shoes)
    hem = [(-0.8 * clothing.skirt, 0.0, 0.08, 0.1)] if clothing.skirt > 0.0 else [(-0.045, 0.0, 0.055, 0.08)]
    pelvis = [(0.06, 0.0, 0.067, 0.086), (0.03, 0.0, 0.073, 0.093), (-0.01, -0.002, 0.082, 0.106), *hem]
    pieces = [
        loft(pelvis, cloth, clothing.coat if clothing.skirt > 0.0 else clothing.trousers, 12),
        loft(_TORSO_RINGS, cloth, clothing.coat, 12),
        head(clothing.skin, clothing.hair),
        *(upper_arm, upper_arm, forearm, forearm, thigh, thigh, shin, shin, foot, foot),
    ]
    return tuple(in_metres(piece, height) for piece in pieces)


def human_poses(posture: Posture, height: float) -> np.ndarray:
    """Poses (n, 13, 4, 4) of `human_pieces`, translations in metres."""
    shoulders, hips = placed(posture.torso, SHOULDERS), placed(posture.pelvis, HIPS)
    torso_left, pelvis_left = posture.torso[:, None, :3, 1], posture.pelvis[:, None, :3, 1]
    feet = [oriented(posture.ankles[:, i], pitch=posture.foot_pitch[:, i]) for i in range(2)]
    poses = np.concatenate(
        [
            np.stack([posture.pelvis, posture.torso, posture.head], axis=1),
            links(shoulders, posture.elbows, torso_left),
            links(posture.elbows, posture.wrists, torso_left),
            links(hips, posture.knees, pelvis_left),
            links(posture.knees, posture.ankles, pelvis_left),
            np.stack(feet, axis=1),
        ],
        axis=1,
    )
    poses[..., :3, 3] *= height
    return poses


def head(skin: Color, hair: Color) -> ColoredMesh:
    """Neck, face and hair in body heights; the crown is one body height above the ground when standing."""
    skull = [
        (-0.02, 0.0, 0.034, 0.036), (0.04, 0.0, 0.03, 0.032), (0.047, 0.018, 0.034, 0.028), (0.075, 0.01, 0.05, 0.038),
        (0.11, 0.006, 0.055, 0.043), (0.14, 0.004, 0.05, 0.041), (0.162, 0.0, 0.03, 0.026),
    ]  # fmt: skip
    cap = [
        (0.05, -0.038, 0.016, 0.024), (0.075, -0.026, 0.034, 0.04), (0.11, -0.012, 0.05, 0.047),
        (0.132, 0.0, 0.06, 0.047), (0.155, 0.0, 0.05, 0.038), (0.168, -0.002, 0.034, 0.026),
        (0.175, -0.002, 0.01, 0.01),
    ]  # fmt: skip
    nose = hull(
        [(0.07, 0.0, 0.083), (0.052, 0.01, 0.082), (0.052, -0.01, 0.082), (0.056, 0.0, 0.106)], Material.PLAIN, skin
    )
    return concatenate([loft(skull, Material.PLAIN, skin), loft(cap, Material.PLAIN, hair), nose])


_TORSO_RINGS: list[Ring] = [
    (-0.02, 0.0, 0.068, 0.088), (0.02, 0.0, 0.071, 0.088), (0.1, 0.004, 0.075, 0.096), (0.17, 0.004, 0.076, 0.106),
    (0.215, -0.002, 0.064, 0.112), (0.235, -0.004, 0.05, 0.1), (0.25, -0.006, 0.044, 0.072),
    (0.264, -0.006, 0.038, 0.04),
]  # fmt: skip
