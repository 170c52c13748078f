"""Figures whose limbs move: people, cyclists, dogs."""

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.world_shapes import CRANK_TURN, CYCLISTS, FIGURES, WALKERS
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull

from drivesplat.world.shapes.animals import DOG_PIECES, FRONT_LEG, HIND_LEG, LEG_ROOTS, LEGS, Dog
from drivesplat.world.shapes.bicycle import BOTTOM_BRACKET, CRANK_LENGTH, GEAR_RATIO, PEDAL_OFFSET, WHEEL_RADIUS
from drivesplat.world.shapes.body import Body
from drivesplat.world.shapes.cyclist import CYCLIST_PIECES, SOLE_ABOVE_PEDAL, Cyclist
from drivesplat.world.shapes.human import (
    BALL,
    HIPS,
    HUMAN_PIECES,
    NECK,
    SHIN,
    SHOULDERS,
    THIGH,
    UPPER_ARM,
    WAIST,
)
from drivesplat.world.shapes.people import Person

TIMES = np.linspace(0.0, 12.0, 241)
SPEED = 1.3
Joint = tuple[str, np.ndarray, str]
"""A piece, a point in its frame (3,) in units of the figure's height, and the piece whose origin is there."""


@pytest.fixture(params=FIGURES)
def figure(request) -> Body:
    return FIGURES[request.param]


@pytest.fixture(params=WALKERS)
def walker(request) -> Person | Dog:
    return WALKERS[request.param]


@pytest.fixture(params=CYCLISTS)
def cyclist(request) -> Cyclist:
    return CYCLISTS[request.param]


def piece_names(figure: Body) -> tuple[str, ...]:
    if isinstance(figure, Person):
        return (*HUMAN_PIECES, "bag") if figure.bag else HUMAN_PIECES
    return CYCLIST_PIECES if isinstance(figure, Cyclist) else DOG_PIECES


def poses_of(figure: Body, name: str, distance: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    return figure.poses(distance, seconds)[:, piece_names(figure).index(name)]


def moved_points(figure: Body, distance: np.ndarray, seconds: np.ndarray) -> list[np.ndarray]:
    """Vertices (n, v, 3) of each piece."""
    poses = figure.poses(distance, seconds)
    return [
        mesh.vertices @ np.swapaxes(poses[:, i, :3, :3], 1, 2) + poses[:, i, None, :3, 3]
        for i, mesh in enumerate(figure.pieces)
    ]


def joints(figure: Body) -> Iterator[Joint]:
    if isinstance(figure, Dog):
        for leg, root in zip(LEGS, LEG_ROOTS, strict=True):
            upper, lower = FRONT_LEG if "front" in leg else HIND_LEG
            yield "body", root, f"{leg} upper leg"
            yield f"{leg} upper leg", np.array([0.0, 0.0, -upper]), f"{leg} lower leg"
            yield f"{leg} lower leg", np.array([0.0, 0.0, -lower]), f"{leg} paw"
        return
    for side in ("left", "right"):
        yield f"{side} thigh", np.array([0.0, 0.0, -THIGH]), f"{side} shin"
        yield f"{side} shin", np.array([0.0, 0.0, -SHIN]), f"{side} foot"
    if isinstance(figure, Person):
        yield "pelvis", WAIST[0], "torso"
        yield "torso", NECK[0], "head"
        for i, side in enumerate(("left", "right")):
            yield "pelvis", HIPS[i], f"{side} thigh"
            yield "torso", SHOULDERS[i], f"{side} upper arm"
            yield f"{side} upper arm", np.array([0.0, 0.0, -UPPER_ARM]), f"{side} forearm"


def test_neighbouring_pieces_share_their_joints(figure):
    """Poses are rigid, and links keep their lengths: a stretched leg would leave its joint."""
    names, poses = piece_names(figure), figure.poses(SPEED * TIMES, TIMES)
    assert poses.shape == (len(TIMES), len(figure.pieces), 4, 4) and len(names) == len(figure.pieces)
    turns = poses[..., :3, :3]
    np.testing.assert_allclose(turns @ np.swapaxes(turns, -1, -2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-12)
    for parent, point, child in joints(figure):
        pose = poses[:, names.index(parent)]
        end = figure.height * (pose[:, :3, :3] @ point) + pose[:, :3, 3]
        assert np.linalg.norm(end - poses[:, names.index(child), :3, 3], axis=-1).max() < 1e-3, (parent, child)


def test_feet_in_contact_rest_in_the_world(walker):
    distance = np.linspace(0.0, 2.2 * walker.stride, 500)
    names, points = piece_names(walker), moved_points(walker, distance, distance)
    feet = [points[i] for i, name in enumerate(names) if name.endswith(("foot", "paw"))]
    assert len(feet) in (2, 4)
    for foot in feet:
        world = foot + distance[:, None, None] * np.array([1.0, 0.0, 0.0])
        for vertex in range(world.shape[1]):
            contact = np.flatnonzero(foot[:, vertex, 2] < 0.003)
            for interval in np.split(contact, np.flatnonzero(np.diff(contact) > 1) + 1):
                assert len(interval) == 0 or np.ptp(world[interval, vertex, :2], axis=0).max() < 0.03
    lowest = np.stack([foot[..., 2].min(axis=1) for foot in feet])
    assert lowest.min(axis=0).max() < 0.003, "at times no foot is on the ground"
    assert lowest.max(axis=1).min() > 0.02, "a foot is never lifted"


def test_figures_are_above_the_ground(figure):
    points = np.concatenate(moved_points(figure, SPEED * TIMES, TIMES), axis=1)
    assert points[..., 2].min() > -0.01
    assert points[..., 2].min(axis=1).max() < 0.01


def test_motion_is_continuous(figure):
    seconds = np.arange(0.0, 3.0, 0.005)
    for points in moved_points(figure, SPEED * seconds, seconds):
        steps = np.linalg.norm(np.diff(points, axis=0), axis=-1) / 0.005
        assert steps.max() < 4.5, "metres per second relative to the body"


def test_wheels_and_crank_turn_with_the_distance(cyclist):
    distance = np.array([0.0, 0.05])
    for name, rate in (("front wheel", 1.0), ("rear wheel", 1.0), ("crank", 1.0 / GEAR_RATIO)):
        rotations = poses_of(cyclist, name, distance, distance)[:, :3, :3]
        turned = rotations[1] @ rotations[0].T
        angle = rate * 0.05 / WHEEL_RADIUS
        forward = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        np.testing.assert_allclose(turned, forward, atol=1e-12, err_msg=name)


def test_feet_are_on_the_pedals(cyclist):
    distance = np.linspace(0.0, CRANK_TURN, 60)
    crank = poses_of(cyclist, "crank", distance, distance)
    for side, name in ((1, "left foot"), (-1, "right foot")):
        end = crank @ np.array([side * CRANK_LENGTH, side * PEDAL_OFFSET, 0.0, 1.0])
        np.testing.assert_allclose(
            np.linalg.norm(end[:, [0, 2]] - BOTTOM_BRACKET[[0, 2]], axis=1), CRANK_LENGTH, atol=1e-9
        )
        ball = poses_of(cyclist, name, distance, distance) @ np.array(
            [BALL[0] * cyclist.height, 0, BALL[1] * cyclist.height, 1]
        )
        np.testing.assert_allclose(ball[:, :3], end[:, :3] + [0.0, 0.0, SOLE_ABOVE_PEDAL], atol=1e-9)


IMAGE, FOCAL, DISTANCE, EYE = 300, 700.0, 10.0, 1.5


def project(points: np.ndarray, azimuth: float) -> np.ndarray:
    """Pixels (..., 2) of a camera at `azimuth` degrees around the figure."""
    cosine, sine = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    depth = DISTANCE - points[..., 0] * cosine - points[..., 1] * sine
    across = points[..., 1] * cosine - points[..., 0] * sine
    return IMAGE / 2 + FOCAL * np.stack([across, EYE - points[..., 2]], axis=-1) / depth[..., None]


def filled(polygons: np.ndarray) -> np.ndarray:
    image = Image.new("1", (IMAGE, IMAGE))
    draw = ImageDraw.Draw(image)
    for polygon in polygons:
        draw.polygon([tuple(corner) for corner in polygon], fill=1)
    return np.array(image)


@pytest.mark.parametrize("name", [name for name in FIGURES if name != "tall cyclist"])
def test_boxes_fit_the_figures_pixels(name):
    """Intersection over union of the projected box's hull with the figure's pixels. The tall cyclist is left out: one
    sees through a bicycle without luggage."""
    figure = FIGURES[name]
    cycle = np.arange(6) / 6
    distance = cycle * (CRANK_TURN if isinstance(figure, Cyclist) else figure.stride)
    points = moved_points(figure, distance, 11.0 * cycle)
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)])
    overlaps = []
    for azimuth in (0, 45, 90, 180, 225):
        corners = project(signs * figure.size, azimuth)
        box = filled(corners[ConvexHull(corners).vertices][None])
        for time in range(len(cycle)):
            triangles = np.concatenate([p[time][mesh.faces] for p, mesh in zip(points, figure.pieces, strict=True)])
            seen = filled(project(triangles, azimuth))
            overlaps.append((box & seen).sum() / (box | seen).sum())
    assert np.median(overlaps) > 0.5
    assert min(overlaps) > 0.35
