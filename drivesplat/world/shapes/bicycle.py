"""Bicycles: a frame, two wheels, a crank; metres, the middle of the wheelbase at x = 0, the ground at z = 0."""

from dataclasses import dataclass

import numpy as np

from drivesplat.world.shapes.limbs import oriented
from drivesplat.world.shapes.mesh import (
    METAL,
    TYRE,
    Color,
    ColoredMesh,
    Material,
    box,
    concatenate,
    cylinder,
    symmetric_hull,
    torus,
)  # fmt: skip

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
