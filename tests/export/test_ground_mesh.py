"""The ground about a path as a mesh: on slopes, beside objects, without LiDAR, and for a vehicle that stands."""

import logging

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from drivesplat.export.ground_mesh import REACH, ground_surface, surface_mesh

NOTHING = np.zeros((0, 3), dtype=np.float32)


def slope(places: np.ndarray) -> np.ndarray:
    """A hill of 8 % along x, with a cross fall of 2 %."""
    return 0.08 * places[..., 0] + 0.02 * places[..., 1]


def poses_on(height, places: np.ndarray) -> np.ndarray:
    """Poses of a vehicle that drives along x over a plane."""
    normal = np.array([-0.08, -0.02, 1.0]) if height is slope else np.array([0.0, 0.0, 1.0])
    up = normal / np.linalg.norm(normal)
    forward = np.cross([0.0, 1.0, 0.0], up)
    forward /= np.linalg.norm(forward)
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3] = np.stack([forward, np.cross(up, forward), up], axis=1)
    poses[:, :2, 3], poses[:, 2, 3] = places, height(places)
    return poses


def straight(length: float) -> np.ndarray:
    return np.column_stack([np.arange(0.0, length, 0.5), np.zeros(int(np.ceil(length / 0.5)))])


def heights(surface, places: np.ndarray) -> np.ndarray:
    return surface.at(torch.from_numpy(np.asarray(places)).float()).double().numpy()


def test_ground_on_a_slope_follows_lidar_and_not_what_stands_on_it():
    random = np.random.default_rng(0)
    places = random.uniform([-25.0, -25.0], [75.0, 25.0], (60_000, 2))
    lidar = np.column_stack([places, slope(places) + random.normal(0.0, 0.02, len(places))])
    car = random.uniform([20.0, 4.0, 0.3], [24.0, 6.0, 1.5], (5000, 3))
    car[:, 2] += slope(car[:, :2])
    inside = ((places > [20.0, 4.0]) & (places < [24.0, 6.0])).all(axis=1)
    surface = ground_surface(poses_on(slope, straight(50.0)), np.concatenate([lidar[~inside], car]).astype(np.float32))
    wanted = np.stack(np.meshgrid(np.arange(-20.0, 70.0, 3.0), np.arange(-20.0, 21.0, 4.0)), axis=-1).reshape(-1, 2)
    assert np.abs(heights(surface, wanted) - slope(wanted)).max() < 0.1
    assert surface.covers(torch.from_numpy(wanted).float()).all()


def test_ground_without_lidar_is_the_plane_of_the_path_and_goes_on():
    surface = ground_surface(poses_on(slope, straight(50.0)), NOTHING)
    near = np.stack(np.meshgrid(np.arange(-4.0, 54.0, 2.0), [-3.0, 0.0, 3.0]), axis=-1).reshape(-1, 2)
    assert np.abs(heights(surface, near) - slope(near)).max() < 0.1
    assert np.abs(heights(surface, np.array([[70.0, 0.0], [25.0, 25.0]]))).max() < 8.0


def test_the_mesh_is_one_sheet_without_holes_as_far_as_the_reach():
    mesh = surface_mesh(ground_surface(poses_on(slope, straight(20.0)), NOTHING))
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0.0).all()
    area = 0.5 * normals[:, 2].sum()
    expected = np.pi * REACH**2 + 2.0 * REACH * 19.5
    assert 0.93 * expected < area < expected
    edges = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 2 and len(mesh.vertices) - len(counts) + len(mesh) == 1  # Euler: a disc
    assert len(np.unique(mesh.triangles)) == len(mesh.vertices)


def test_a_standing_vehicle_has_ground_about_it():
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(1).normal(0.0, 0.005, (40, 3))
    surface = ground_surface(poses, NOTHING)
    assert np.abs(heights(surface, np.array([[0.0, 0.0], [20.0, 0.0], [0.0, -20.0]]))).max() < 0.05


def test_a_path_that_crosses_itself_on_a_bridge_is_reported(caplog):
    along = poses_on(lambda places: 0.0 * places[..., 0], straight(40.0))
    over = along.copy()
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    over[:, :3, :3] = turn
    over[:, :3, 3] = along[:, :3, 3] @ turn.T + [20.0, -20.0, 6.0]
    with caplog.at_level(logging.WARNING):
        ground_surface(np.concatenate([along, over]), NOTHING)
    assert "off the path of the vehicle" in caplog.text
    caplog.clear()
    ground_surface(along, NOTHING)
    assert caplog.text == ""
