"""Meshes of the demo world: closed, oriented outward, on the ground, as large as asked for. Their forms and colours are
held by digests (test_worlds.py)."""

import numpy as np
import pytest
import trimesh
from helpers.world_shapes import ALL, FURNITURE, IN_THE_AIR, PLANTS, RED, STANDING, VEHICLES, seeded

from drivesplat.world.shapes.mesh import Material, SurfaceClass


def test_meshes_are_complete_closed_and_face_outward():
    for name, make in ALL.items():
        body = make()
        assert body.faces.shape == (len(body.material), 3) and body.color.shape == body.faces.shape, name
        assert set(body.material.tolist()) <= {int(material) for material in Material}, name
        assert body.color.min() >= 0.0 and body.color.max() <= 1.0, name
        assert body.faces.min() == 0 and body.faces.max() == len(body.vertices) - 1, name
        assert body.texture.shape == body.vertices.shape and np.isfinite(body.vertices).all(), name
        assert (trimesh.triangles.area(body.triangles) > 1e-12).mean() > 0.97, name
        if name in IN_THE_AIR or name in STANDING:
            parts = trimesh.Trimesh(body.vertices, body.faces, process=False).split(only_watertight=False)
            assert sum(len(part.faces) for part in parts) == len(body.faces), name
            assert all(part.is_watertight and part.volume > 0 for part in parts), name
        if name not in IN_THE_AIR:
            assert body.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9), f"{name} stands on the ground"


def test_shapes_have_their_size_and_class():
    for name, (make, size) in VEHICLES.items():
        body = make(size, RED)
        np.testing.assert_allclose(body.size, size, atol=1e-6)
        np.testing.assert_allclose((body.vertices.max(axis=0) + body.vertices.min(axis=0))[:2], 0.0, atol=2e-6)
        assert (body.surface_class == SurfaceClass.VEHICLE).all() and len(body.faces) < 3000, name
        assert (body.color[body.material == Material.PAINT] == RED).all(axis=1).any(), name
    for name, (make, classes) in FURNITURE.items():
        assert set(make().surface_class.tolist()) == {int(item) for item in classes}, name
    for name, make in PLANTS.items():
        first, second = (make(seeded(seed)) for seed in (1, 2))
        leaves = first.material == Material.LEAVES
        assert (
            leaves.mean() > 0.3
            and len(first.faces) <= 1500
            and (first.surface_class[leaves] == SurfaceClass.VEGETATION).all()
        ), name
        assert not np.array_equal(first.vertices, second.vertices), f"{name} differs by seed"
