"""Meshes of the demo world: closed, oriented outward, on the ground, as large as asked for. Their forms and colours are
held by digests (test_worlds.py)."""

import numpy as np
import pytest
import trimesh
from helpers.world_shapes import ALL, FURNITURE, IN_THE_AIR, PLANTS, RED, STANDING, VEHICLES, seeded

from drivesplat.world.shapes import mesh, vehicles
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


@pytest.mark.parametrize(
    ("shape", "volume"),
    [("box", 2.0 * 4.0 * 3.0), ("cylinder", np.pi * 0.25 * 2.0), ("ball", 4 / 3 * np.pi * 0.5)],
)
def test_primitives_have_their_volume(shape, volume):
    body = ALL[shape]()
    found = trimesh.Trimesh(body.vertices, body.faces).volume
    assert 0.9 * volume < found <= volume + 1e-9, "round solids are inscribed polyhedra"


@pytest.mark.parametrize(
    ("kind", "category", "low", "high"),
    [
        ("car", "vehicle.car", (3.8, 1.7, 1.4), (4.9, 1.95, 1.76)),
        ("van", "vehicle.truck", (5.2, 1.99, 2.29), (6.01, 2.16, 2.66)),
        ("truck", "vehicle.truck", (7.0, 2.39, 3.19), (9.01, 2.53, 3.61)),
        ("bus", "vehicle.bus.rigid", (10.79, 2.49, 2.99), (11.21, 2.56, 3.21)),
    ],
)
def test_random_vehicles_vary_within_the_range_of_their_kind(kind, category, low, high):
    drawn = [vehicles.vehicle(kind, seeded(seed)) for seed in range(12)]
    assert {found for _, found in drawn} == {category}
    sizes = np.array([body.size for body, _ in drawn])
    assert (sizes >= np.subtract(low, 1e-9)).all() and (sizes <= high).all() and (sizes.std(axis=0) > 0.01).all()
    again = vehicles.vehicle(kind, seeded(0))[0]
    np.testing.assert_array_equal(again.vertices, drawn[0][0].vertices)


def test_an_unknown_kind_of_vehicle_is_refused():
    with pytest.raises(ValueError, match="tram"):
        vehicles.vehicle("tram", seeded())


def test_the_ego_vehicle_lies_below_the_lidar_with_its_rear_axle_at_the_origin():
    ego = vehicles.ego_vehicle()
    low, high = ego.vertices.min(axis=0), ego.vertices.max(axis=0)
    np.testing.assert_allclose(low, (-0.65, -0.865, 0.0), atol=0.01)
    np.testing.assert_allclose(high, (3.43, 0.865, 1.56), atol=0.01)
    around = np.abs(ego.vertices[:, 0] - 0.944) < 1.0
    assert ego.vertices[around, 2].max() < 1.84 - 0.2
    tyres = ego.triangles[(ego.color == mesh.TYRE).all(axis=1)].reshape(-1, 3)
    rear = tyres[tyres[:, 0] < 1.0]
    assert (rear[:, 0].max() + rear[:, 0].min()) / 2 == pytest.approx(0.0, abs=0.01)
    assert (ego.surface_class == SurfaceClass.VEHICLE).all()
    assert (vehicles.ego_rear().surface_class == SurfaceClass.VEHICLE).all()
