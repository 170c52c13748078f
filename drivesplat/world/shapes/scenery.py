"""Street furniture, each on the ground at the origin unless stated otherwise."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import trimesh

from drivesplat.world.shapes.mesh import (
    METAL,
    TYRE,
    Color,
    ColoredMesh,
    Material,
    Numbers,
    SurfaceClass,
    box,
    concatenate,
    cylinder,
    ellipsoid,
    uniform,
)
from drivesplat.world.shapes.vehicle_parts import HEADLIGHT, WINDSCREEN, brand_panel

WHITE, DARK, WOOD = (0.8, 0.8, 0.8), (0.05, 0.055, 0.06), (0.28, 0.17, 0.08)
POSTERS: tuple[Color, ...] = ((0.65, 0.5, 0.1), (0.1, 0.3, 0.5), (0.6, 0.12, 0.1), (0.55, 0.55, 0.5))


def street_lamp(height: float, arm: float) -> ColoredMesh:
    """A pole with a lamp at the end of an arm of length `arm` along y."""
    pole = cylinder((0, 0, 0), (0, 0, height), 0.08, Material.METAL, METAL)
    foot = cylinder((0, 0, 0), (0, 0, 0.9), 0.12, Material.METAL, DARK)
    bar = cylinder((0, 0, height), (0, arm, height + 0.2), 0.05, Material.METAL, METAL)
    hood = box((-0.17, arm - 0.34, height + 0.18), (0.17, arm + 0.34, height + 0.25), Material.PLAIN, DARK)
    lamp = box((-0.15, arm - 0.3, height + 0.1), (0.15, arm + 0.3, height + 0.2), Material.LAMP, HEADLIGHT)
    return concatenate([pole, foot, bar, hood, lamp]).classified(SurfaceClass.POLE)


def sign(color: Color) -> ColoredMesh:
    """A round traffic sign facing -x: a bar on a white face, and a smaller panel below."""
    pole = cylinder((0, 0, 0), (0, 0, 2.75), 0.03, Material.METAL, METAL).classified(SurfaceClass.POLE)
    rim = cylinder((-0.05, 0, 2.4), (-0.03, 0, 2.4), 0.32, Material.PLAIN, color)
    face = cylinder((-0.06, 0, 2.4), (-0.05, 0, 2.4), 0.25, Material.PLAIN, WHITE)
    symbol = box((-0.068, -0.17, 2.36), (-0.06, 0.17, 2.44), Material.PLAIN, DARK)
    panel = brand_panel((-0.05, -0.25, 1.85), (-0.03, 0.25, 2.02), WHITE)
    return concatenate([pole, concatenate([rim, face, symbol, panel]).classified(SurfaceClass.SIGN)])


def street_name_sign() -> ColoredMesh:
    """A pole with two panels of names, along x and along y."""
    color = (0.04, 0.1, 0.4)
    pole = cylinder((0, 0, 0), (0, 0, 2.9), 0.03, Material.METAL, METAL).classified(SurfaceClass.POLE)
    along = brand_panel((0.05, -0.012, 2.6), (1.0, 0.012, 2.8), color)
    across = brand_panel((-0.012, -1.0, 2.36), (0.012, -0.05, 2.56), color)
    return concatenate([pole, along.classified(SurfaceClass.SIGN), across.classified(SurfaceClass.SIGN)])


def cone() -> ColoredMesh:
    mesh = trimesh.creation.cone(0.17, 0.7, sections=16)
    base = box((-0.2, -0.2, 0), (0.2, 0.2, 0.04), Material.PLAIN, TYRE)
    return concatenate([base, uniform(mesh, Material.STRIPES, (0.8, 0.25, 0.03))])


def fence(length: float) -> ColoredMesh:
    """Posts and two rails along x, 1.1 m high, with a bar every 0.15 m."""
    half, height, color = length / 2, 1.1, DARK
    posts = [
        box((x - 0.03, -0.03, 0.0), (x + 0.03, 0.03, height), Material.METAL, color)
        for x in np.linspace(-half, half, max(2, round(length / 2) + 1))
    ]
    rails = [box((-half, -0.02, z - 0.02), (half, 0.02, z + 0.02), Material.METAL, color) for z in (0.15, height - 0.1)]
    bars = [
        box((x - 0.008, -0.008, 0.16), (x + 0.008, 0.008, height - 0.1), Material.METAL, color)
        for x in np.arange(-half + 0.15, half - 0.01, 0.15)
    ]
    return concatenate([*posts, *rails, *bars]).classified(SurfaceClass.FENCE)


def bench() -> ColoredMesh:
    """A bench 1.8 m long, along x, whose front faces y."""
    seat = [box((-0.9, y, 0.43), (0.9, y + 0.09, 0.47), Material.PLAIN, WOOD) for y in (-0.2, -0.08, 0.04, 0.16)]
    back = [box((-0.9, -0.27, z), (0.9, -0.23, z + 0.1), Material.PLAIN, WOOD) for z in (0.58, 0.74)]
    legs = [
        part
        for x in (-0.75, 0.75)
        for part in (
            box((x - 0.03, -0.22, 0.0), (x + 0.03, -0.16, 0.43), Material.METAL, DARK),
            box((x - 0.03, 0.17, 0.0), (x + 0.03, 0.23, 0.43), Material.METAL, DARK),
            box((x - 0.03, -0.3, 0.4), (x + 0.03, -0.27, 0.86), Material.METAL, DARK),
        )
    ]
    return concatenate([*seat, *back, *legs])


def litter_bin() -> ColoredMesh:
    """A round bin with a lid."""
    drum = cylinder((0, 0, 0.05), (0, 0, 0.85), 0.27, Material.PLAIN, (0.05, 0.12, 0.06))
    lid = cylinder((0, 0, 0.9), (0, 0, 0.96), 0.29, Material.METAL, DARK)
    stem = cylinder((0, 0, 0.0), (0, 0, 0.92), 0.05, Material.METAL, DARK)
    return concatenate([drum, lid, stem])


def mailbox() -> ColoredMesh:
    """A letter box on a foot, whose slot faces y."""
    color = (0.6, 0.42, 0.03)
    parts = [
        box((-0.06, -0.06, 0.0), (0.06, 0.06, 0.7), Material.METAL, METAL),
        box((-0.22, -0.18, 0.65), (0.22, 0.18, 1.25), Material.PAINT, color),
        box((-0.24, -0.2, 1.24), (0.24, 0.2, 1.3), Material.PAINT, color),
        box((-0.15, 0.175, 1.08), (0.15, 0.19, 1.12), Material.PLAIN, DARK),
        brand_panel((-0.15, 0.175, 0.75), (0.15, 0.19, 1.0), WHITE),
    ]
    return concatenate(parts)


def hydrant() -> ColoredMesh:
    """A fire hydrant with outlets along x and y."""
    color = (0.55, 0.06, 0.04)
    parts = [
        cylinder((0, 0, 0), (0, 0, 0.06), 0.17, Material.PLAIN, color),
        cylinder((0, 0, 0.05), (0, 0, 0.6), 0.11, Material.PLAIN, color),
        ellipsoid((0, 0, 0.62), (0.13, 0.13, 0.12), Material.PLAIN, color),
        cylinder((-0.2, 0, 0.45), (0.2, 0, 0.45), 0.05, Material.METAL, METAL),
        cylinder((0, 0, 0.4), (0, 0.2, 0.4), 0.07, Material.METAL, METAL),
    ]
    return concatenate(parts)


def bollard() -> ColoredMesh:
    """A bollard 0.9 m high with a light band."""
    post = cylinder((0, 0, 0), (0, 0, 0.9), 0.06, Material.METAL, DARK)
    band = cylinder((0, 0, 0.74), (0, 0, 0.82), 0.063, Material.PLAIN, WHITE)
    return concatenate([post, band]).classified(SurfaceClass.POLE)


def bus_shelter(random: np.random.Generator) -> ColoredMesh:
    """A bus stop's shelter 4 m long along x, open towards y: glass walls, a roof, a bench, a poster, a sign."""
    posts = [
        box((x - 0.04, y - 0.04, 0.0), (x + 0.04, y + 0.04, 2.45), Material.METAL, METAL)
        for x in (-2.0, -0.67, 0.67, 2.0)
        for y in (-0.7,)
    ] + [box((x - 0.04, 0.56, 0.0), (x + 0.04, 0.64, 2.45), Material.METAL, METAL) for x in (-2.0, 2.0)]
    panes = [box((x, -0.71, 0.25), (x + 1.25, -0.69, 2.2), Material.GLASS, WINDSCREEN) for x in (-1.96, -0.63, 0.71)]
    panes.append(box((-2.01, -0.66, 0.25), (-1.99, 0.56, 2.2), Material.GLASS, WINDSCREEN))
    roof = box((-2.15, -0.85, 2.45), (2.15, 0.95, 2.55), Material.METAL, (0.2, 0.21, 0.23))
    poster = brand_panel((1.95, -0.6, 0.4), (2.05, 0.5, 2.1), POSTERS[random.integers(len(POSTERS))])
    seat = box((-1.6, -0.6, 0.45), (1.2, -0.25, 0.5), Material.PLAIN, WOOD)
    feet = [box((x - 0.03, -0.5, 0.0), (x + 0.03, -0.4, 0.46), Material.METAL, METAL) for x in (-1.4, 1.0)]
    flag = brand_panel((2.3, -0.02, 2.3), (2.7, 0.02, 2.75), (0.6, 0.5, 0.05))
    pole = cylinder((2.28, 0, 0), (2.28, 0, 2.85), 0.035, Material.METAL, METAL)
    shelter = concatenate([*posts, *panes, roof, seat, *feet]).classified(SurfaceClass.OBJECT)
    signs = concatenate([poster, flag]).classified(SurfaceClass.SIGN)
    return concatenate([shelter, signs, pole.classified(SurfaceClass.POLE)])


def advertising_column(random: np.random.Generator) -> ColoredMesh:
    """A round column of posters, 3 m high."""
    foot = cylinder((0, 0, 0), (0, 0, 0.35), 0.66, Material.PLAIN, (0.3, 0.3, 0.29))
    drum = uniform(trimesh.creation.cylinder(0.6, 2.4, sections=24), Material.SIGN, POSTERS[0])
    corners = drum.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sector = (np.arctan2(normals[:, 1], normals[:, 0]) + 0.1) // (np.pi / 3)
    order = random.permutation(6) % len(POSTERS)
    drum = replace(drum, color=np.array(POSTERS)[order[sector.astype(int) % 6]])
    cap = cylinder((0, 0, 2.7), (0, 0, 2.85), 0.7, Material.METAL, DARK)
    top = uniform(trimesh.creation.cone(0.55, 0.3, sections=16), Material.METAL, DARK).moved((0.0, 0.0, 2.85))
    return concatenate([foot, drum.moved((0.0, 0.0, 1.5)), cap, top]).classified(SurfaceClass.OBJECT)


def overhead_wire(start: Numbers, end: Numbers) -> ColoredMesh:
    """A wire that hangs between two points, 0.4 m below the straight line in its middle."""
    share = np.linspace(0.0, 1.0, 9)[:, None]
    points = (1 - share) * np.asarray(start, dtype=float) + share * np.asarray(end, dtype=float)
    points[:, 2] -= 4 * 0.4 * (share * (1 - share))[:, 0]
    pieces = [
        uniform(trimesh.creation.cylinder(0.012, segment=[a, b], sections=5), Material.PLAIN, DARK)
        for a, b in pairwise(points)
    ]
    return concatenate(pieces).classified(SurfaceClass.POLE)
