"""Depth images fused to a mesh: shape, side, holes, what only one image shows, and the ground where none looks."""

import numpy as np
import pytest
import torch

from drivesplat.export import drive_mesh
from drivesplat.export.drive_mesh import DepthImage, fused_mesh, without_small_pieces
from drivesplat.io.triangle_mesh import TriangleMesh
from drivesplat.model.height_field import HeightField

K = np.array([[70.0, 0.0, 50.0], [0.0, 70.0, 40.0], [0.0, 0.0, 1.0]])
SIZE = (80, 100)
RADIUS, EDGE = 2.0, 0.2


def looking_at_origin(place: np.ndarray) -> np.ndarray:
    """The pose of an OpenCV camera at a place, which looks at the origin; z is up."""
    z = -place / np.linalg.norm(place)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), place
    return pose


def rays_of(pose: np.ndarray) -> np.ndarray:
    rows, columns = np.indices(SIZE)
    rays = np.stack([(columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1], np.ones(SIZE)], axis=-1)
    return rays @ pose[:3, :3].T


def image_of_ball(place: np.ndarray) -> DepthImage:
    """The depth of a ball about the origin."""
    pose = looking_at_origin(place)
    rays = rays_of(pose)
    a, b, c = (rays**2).sum(-1), 2.0 * rays @ place, place @ place - RADIUS**2
    root = b**2 - 4.0 * a * c
    depth = np.where(root > 0.0, (-b - np.sqrt(np.maximum(root, 0.0))) / (2.0 * a), np.inf)
    return DepthImage(depth.astype(np.float32), K, pose)


def around(distance: float, count: int = 10) -> list[np.ndarray]:
    """Places on a sphere about the origin, evenly spread."""
    number = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * number / count, np.pi * (1.0 + 5.0**0.5) * number
    across = np.sqrt(1.0 - height**2)
    return list(distance * np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1))


def facing(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    """The middles (t, 3) and the area vectors (t, 3) of triangles."""
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    return (a + b + c) / 3.0, 0.5 * np.cross(b - a, c - a)


def test_a_ball_seen_from_all_sides_is_a_closed_ball_with_normals_outwards():
    mesh = fused_mesh([image_of_ball(place) for place in around(6.0, 16)], EDGE)
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radii - RADIUS).max() < EDGE and abs(radii.mean() - RADIUS) < 0.2 * EDGE
    middles, areas = facing(mesh)
    assert ((middles * areas).sum(axis=1) > 0.0).mean() > 0.999
    assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(4.0 * np.pi * RADIUS**2, rel=0.1)
    edges = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # no hole, also between tiles


def test_a_view_from_one_side_has_no_back():
    place = np.array([6.0, 0.0, 0.0])
    mesh = fused_mesh([image_of_ball(place)], EDGE)
    assert len(mesh) and mesh.vertices[:, 0].min() >= 0.0
    middles, areas = facing(mesh)
    towards = ((place - middles) * areas).sum(axis=1)[middles[:, 0] > 1.0]  # not at the edge of what it hides
    assert towards[towards < 0.0].sum() > -0.04 * towards.sum()


def test_what_one_image_shows_and_others_look_through_is_left_out():
    images = [image_of_ball(place) for place in around(6.0, 16)]
    ghost = images[0].depth.copy()
    ghost[20:60, 30:70] = 3.0
    with_ghost = [DepthImage(ghost, K, images[0].camera_to_world), *images[1:]]
    alone, seen = fused_mesh(with_ghost[:1], EDGE), fused_mesh(with_ghost, EDGE)
    at = images[0].camera_to_world[:3, 3] * (3.0 / 6.0)
    assert np.linalg.norm(alone.vertices - at, axis=1).min() < 0.5
    assert np.linalg.norm(seen.vertices, axis=1).max() < RADIUS + EDGE


def test_ground_seen_at_a_grazing_angle_is_flat():
    pose = looking_at_origin(np.array([-12.0, 0.3, 1.5]))
    down = rays_of(pose)[..., 2]
    depth = np.where(down < -0.05, 1.5 / np.maximum(-down, 0.05), 0.0)
    mesh = fused_mesh([DepthImage(depth.astype(np.float32), K, pose)], EDGE)
    assert np.percentile(np.abs(mesh.vertices[:, 2]), 99) < 0.1 * EDGE and np.abs(mesh.vertices[:, 2]).max() < EDGE
    assert mesh.vertices[:, 0].max() > 0.0  # 12 m before the camera
    assert (facing(mesh)[1][:, 2] > 0.0).all()


def test_the_ground_closes_what_no_image_shows():
    ground = HeightField(torch.tensor([-5.0, -5.0]), 1.0, torch.full((11, 11), -RADIUS), torch.ones(10, 10).bool())
    seen = [image_of_ball(place) for place in around(6.0, 16) if place[2] > -1.0]
    images = [DepthImage(np.where(image.shows, image.depth, 0.0), K, image.camera_to_world) for image in seen]
    mesh = fused_mesh(images, EDGE, ground)
    low = mesh.vertices[np.abs(mesh.vertices[:, 2] + RADIUS) < 1e-3]
    assert low[:, :2].min() < -4.5 and low[:, :2].max() > 4.5
    alone = fused_mesh([], EDGE, ground)
    assert np.abs(alone.vertices[:, 2] + RADIUS).max() < 1e-3
    areas = facing(alone)[1]
    assert (areas[:, 2] > 0.0).all() and areas[:, 2].sum() == pytest.approx(100.0, rel=0.15)


def test_too_many_blocks_make_the_voxels_coarser(monkeypatch):
    images = [image_of_ball(place) for place in around(6.0, 16)]
    fine = fused_mesh(images, EDGE)
    monkeypatch.setattr(drive_mesh, "MAX_BLOCKS", 30)
    coarse = fused_mesh(images, EDGE)
    assert 0 < len(coarse) < 0.75 * len(fine)
    assert np.abs(np.linalg.norm(coarse.vertices, axis=1) - RADIUS).max() < 0.5


def test_nothing_seen_is_an_empty_mesh_and_small_pieces_are_left_out():
    blank = DepthImage(np.zeros(SIZE, dtype=np.float32), K, np.eye(4))
    assert len(fused_mesh([blank], EDGE)) == 0 == len(fused_mesh([], EDGE))
    strip = np.stack([np.arange(6), np.arange(6) + 1, np.arange(6) + 2], axis=1)
    both = np.concatenate([strip, [[20, 21, 22]]])
    kept = without_small_pieces(TriangleMesh(np.arange(75.0).reshape(25, 3), both), 3)
    assert len(kept) == 6 and len(kept.vertices) == 8 and kept.vertices.max() == 23.0
