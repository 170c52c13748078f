"""Scenery and street furniture."""

import numpy as np
import trimesh

from drivesplat.demo.shapes.mesh import (
    BARK,
    METAL,
    TYRE,
    Color,
    ColoredMesh,
    Material,
    Numbers,
    box,
    concatenate,
    cylinder,
    ellipsoid,
    uniform,
)  # fmt: skip
from drivesplat.demo.shapes.vehicles import HEADLIGHT


def tree(height: float, rng: np.random.Generator) -> ColoredMesh:
    """A trunk, and a crown of five ellipsoids."""
    crown = [
        ellipsoid(
            (*rng.uniform(-0.17, 0.17, 2) * height, height * rng.uniform(0.62, 0.85)),
            rng.uniform(0.15, 0.25, 3) * height, Material.LEAVES,
            (rng.uniform(0.06, 0.12), rng.uniform(0.16, 0.24), rng.uniform(0.03, 0.06)),
        )
        for _ in range(5)
    ]  # fmt: skip
    return concatenate([cylinder((0, 0, 0), (0, 0, 0.65 * height), 0.035 * height, Material.PLAIN, BARK), *crown])


def building(low: Numbers, high: Numbers, color: Color) -> ColoredMesh:
    """A building between two corners, with a flat roof."""
    x0, y0, z1 = low[0], low[1], high[2]
    roof = box((x0 - 0.3, y0 - 0.3, z1), (high[0] + 0.3, high[1] + 0.3, z1 + 0.4), Material.PLAIN, METAL)
    return concatenate([box(low, high, Material.FACADE, color), roof])


def street_lamp(height: float, arm: float) -> ColoredMesh:
    """A pole with a lamp at the end of an arm of length `arm` along y."""
    pole = cylinder((0, 0, 0), (0, 0, height), 0.08, Material.PLAIN, METAL)
    bar = cylinder((0, 0, height), (0, arm, height + 0.2), 0.05, Material.PLAIN, METAL)
    lamp = box((-0.15, arm - 0.3, height + 0.1), (0.15, arm + 0.3, height + 0.2), Material.LAMP, HEADLIGHT)
    return concatenate([pole, bar, lamp])


def sign(color: Color) -> ColoredMesh:
    """A traffic sign facing -x."""
    disc = cylinder((-0.05, 0, 2.4), (-0.03, 0, 2.4), 0.32, Material.PLAIN, color)
    face = cylinder((-0.07, 0, 2.4), (-0.05, 0, 2.4), 0.24, Material.PLAIN, (0.8, 0.8, 0.8))
    return concatenate([cylinder((0, 0, 0), (0, 0, 2.7), 0.03, Material.PLAIN, METAL), disc, face])


def cone() -> ColoredMesh:
    """A traffic cone."""
    mesh = trimesh.creation.cone(0.17, 0.7, sections=16)
    base = box((-0.2, -0.2, 0), (0.2, 0.2, 0.04), Material.PLAIN, TYRE)
    return concatenate([base, uniform(mesh, Material.STRIPES, (0.8, 0.25, 0.03))])


def litter_bin() -> ColoredMesh:
    """A litter bin."""
    return cylinder((0, 0, 0), (0, 0, 0.95), 0.28, Material.PLAIN, (0.05, 0.12, 0.06))
