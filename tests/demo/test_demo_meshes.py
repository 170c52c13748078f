"""Meshes of the demo world: closed, oriented outward, on the ground; their sizes, classes and numbers of triangles."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from drivesplat.demo.layout import WINDOW
from drivesplat.demo.shapes import buildings, mesh, plants, scenery, vehicle_parts, vehicles
from drivesplat.demo.shapes.mesh import ColoredMesh, Material, SurfaceClass

RED = (0.5, 0.1, 0.1)
GREY = (0.3, 0.3, 0.3)
BOX = ((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0))
MAX_VEHICLE_TRIANGLES, MAX_TREE_TRIANGLES = 3000, 1500


def seeded(seed: int = 3) -> np.random.Generator:
    return np.random.default_rng(seed)


VEHICLES: dict[str, tuple[Callable[..., ColoredMesh], tuple[float, float, float]]] = {
    "car": (vehicles.car, (4.5, 1.85, 1.5)),
    "hatchback": (vehicles.hatchback, (4.0, 1.75, 1.5)),
    "estate": (vehicles.estate, (4.7, 1.9, 1.7)),
    "van": (vehicles.van, (5.4, 2.05, 2.5)),
    "short truck": (vehicles.truck, (7.0, 2.4, 3.2)),
    "long truck": (vehicles.truck, (9.0, 2.5, 3.6)),
    "bus": (vehicles.bus, (11.0, 2.55, 3.1)),
}
PLANTS: dict[str, Callable[[np.random.Generator], ColoredMesh]] = {
    "tree": lambda random: plants.tree(7.0, random),
    "tree over the road": lambda random: plants.tree(8.0, random, 2.5),
    "hedge": lambda random: plants.hedge(4.0, 1.2, 0.6, random),
    "planter": plants.planter,
}
FURNITURE: dict[str, tuple[Callable[[], ColoredMesh], set[SurfaceClass]]] = {
    "street lamp": (lambda: scenery.street_lamp(6.5, -1.5), {SurfaceClass.POLE}),
    "sign": (lambda: scenery.sign(RED), {SurfaceClass.POLE, SurfaceClass.SIGN}),
    "street name": (scenery.street_name_sign, {SurfaceClass.POLE, SurfaceClass.SIGN}),
    "cone": (scenery.cone, {SurfaceClass.OBJECT}),
    "fence": (lambda: scenery.fence(6.0), {SurfaceClass.FENCE}),
    "bench": (scenery.bench, {SurfaceClass.OBJECT}),
    "litter bin": (scenery.litter_bin, {SurfaceClass.OBJECT}),
    "mailbox": (scenery.mailbox, {SurfaceClass.OBJECT}),
    "hydrant": (scenery.hydrant, {SurfaceClass.OBJECT}),
    "bollard": (scenery.bollard, {SurfaceClass.POLE}),
    "shelter": (lambda: scenery.bus_shelter(seeded()), {SurfaceClass.OBJECT, SurfaceClass.SIGN, SurfaceClass.POLE}),
    "advertising column": (lambda: scenery.advertising_column(seeded()), {SurfaceClass.OBJECT}),
    "door": (lambda: buildings.front_door(RED), {SurfaceClass.BUILDING}),
    "plain building": (lambda: buildings.building((0, 10, 0), (12, 22, 9), GREY), {SurfaceClass.BUILDING}),
    "building": (lambda: buildings.building((0, 10, 0), (16, 22, 12), GREY, seeded()), {SurfaceClass.BUILDING}),
}
IN_THE_AIR: dict[str, Callable[[], ColoredMesh]] = {
    "awning": lambda: buildings.awning(3.0, RED),
    "balcony": lambda: buildings.balcony(2.5),
    "hanging sign": lambda: buildings.hanging_sign(RED),
    "wire": lambda: scenery.overhead_wire((0.0, 0.0, 8.0), (20.0, 0.0, 8.0)),
}
STANDING: dict[str, Callable[[], ColoredMesh]] = {
    "box": lambda: mesh.box(*BOX, Material.PLAIN, RED),
    "cylinder": lambda: mesh.cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 0.5, Material.PLAIN, RED),
    "ball": lambda: mesh.ellipsoid((0.0, 0.0, 1.0), (1.0, 0.5, 1.0), Material.PLAIN, RED),
    **{name: (lambda make=make, size=size: make(size, RED)) for name, (make, size) in VEHICLES.items()},
    **{name: make for name, (make, _) in FURNITURE.items()},
}
ALL = {**STANDING, **IN_THE_AIR, **{name: (lambda make=make: make(seeded())) for name, make in PLANTS.items()}}


@pytest.mark.parametrize("name", [*STANDING, *IN_THE_AIR])
def test_every_part_is_closed_and_faces_outward(name):
    body = ALL[name]()
    parts = trimesh.Trimesh(body.vertices, body.faces, process=False).split(only_watertight=False)
    assert len(parts) >= 1 and sum(len(part.faces) for part in parts) == len(body.faces)
    for part in parts:
        assert part.is_watertight and part.volume > 0


@pytest.mark.parametrize("name", [*STANDING, *PLANTS])
def test_meshes_stand_on_the_ground(name):
    assert ALL[name]().vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("name", ALL)
def test_every_face_has_a_material_a_colour_and_an_area(name):
    body = ALL[name]()
    assert body.faces.shape == (len(body.material), 3) and body.color.shape == body.faces.shape
    assert set(body.material.tolist()) <= {int(material) for material in Material}
    assert body.color.min() >= 0.0 and body.color.max() <= 1.0
    assert body.faces.min() == 0 and body.faces.max() == len(body.vertices) - 1
    assert body.texture.shape == body.vertices.shape and np.isfinite(body.vertices).all()
    areas = trimesh.triangles.area(body.triangles)
    assert (areas > 1e-12).mean() > 0.97


@pytest.mark.parametrize("name", ALL)
def test_equal_seeds_give_equal_meshes(name):
    first, second = ALL[name](), ALL[name]()
    for attribute in ("vertices", "texture", "faces", "material", "color", "surface_class"):
        np.testing.assert_array_equal(getattr(first, attribute), getattr(second, attribute))


@pytest.mark.parametrize(
    ("shape", "volume"),
    [("box", 2.0 * 4.0 * 3.0), ("cylinder", np.pi * 0.25 * 2.0), ("ball", 4 / 3 * np.pi * 0.5)],
)
def test_primitives_have_their_volume(shape, volume):
    body = ALL[shape]()
    found = trimesh.Trimesh(body.vertices, body.faces).volume
    assert 0.9 * volume < found <= volume + 1e-9, "round solids are inscribed polyhedra"


@pytest.mark.parametrize("name", VEHICLES)
def test_vehicles_fill_the_box_asked_for(name):
    make, size = VEHICLES[name]
    body = make(size, RED)
    np.testing.assert_allclose(body.size, size, atol=1e-6)
    center = (body.vertices.max(axis=0) + body.vertices.min(axis=0)) / 2
    np.testing.assert_allclose(center[:2], 0.0, atol=1e-6)


@pytest.mark.parametrize("name", VEHICLES)
def test_vehicles_have_paint_glass_lights_and_four_tyres_on_the_ground(name):
    make, size = VEHICLES[name]
    body = make(size, RED)
    assert (body.surface_class == SurfaceClass.VEHICLE).all() and len(body.faces) < MAX_VEHICLE_TRIANGLES
    assert (body.color[body.material == Material.PAINT] == RED).all(axis=1).any()
    assert (body.material == Material.GLASS).sum() >= 3 * 12, "a windscreen and side windows"
    lights = (body.material == Material.LAMP) & (body.color[:, 0] > 0.7)
    rear = body.triangles[:, :, 0].max(axis=1) < 0
    assert (body.color[lights & rear] == vehicle_parts.TAIL_LIGHT).all() and (lights & rear).any()
    assert (body.color[lights & ~rear] == vehicle_parts.HEADLIGHT).all() and (lights & ~rear).any()
    tyres = (body.color == mesh.TYRE).all(axis=1)
    corners = body.triangles[tyres].reshape(-1, 3)
    contact = corners[corners[:, 2] < 1e-9]
    assert {(np.sign(x), np.sign(y)) for x, y, _ in contact} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}


@pytest.mark.parametrize("name", ["car", "hatchback", "estate", "van"])
def test_the_cabin_is_symmetric_and_narrower_than_the_body(name):
    make, size = VEHICLES[name]
    body = make(size, RED)
    np.testing.assert_allclose(*(np.sort(side * body.vertices[:, 1])[-40:] for side in (-1, 1)), atol=0.01)
    glass = body.triangles[body.material == Material.GLASS].reshape(-1, 3)
    assert np.abs(glass[:, 1]).max() < size[1] / 2 and glass[:, 2].min() > 0.4 * size[2]


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


@pytest.mark.parametrize("name", FURNITURE)
def test_furniture_and_buildings_have_their_class(name):
    make, classes = FURNITURE[name]
    assert set(make().surface_class.tolist()) == {int(item) for item in classes}


@pytest.mark.parametrize("name", PLANTS)
def test_plants_are_vegetation_with_leaves_and_differ_by_seed(name):
    first, second = (PLANTS[name](seeded(seed)) for seed in (1, 2))
    for body in (first, second):
        leaves = body.material == Material.LEAVES
        assert leaves.mean() > 0.3 and (body.surface_class[leaves] == SurfaceClass.VEGETATION).all()
        assert len(body.faces) <= MAX_TREE_TRIANGLES
    assert not np.array_equal(first.vertices, second.vertices)


@pytest.mark.parametrize("height", [5.0, 7.0, 9.0])
def test_a_tree_has_its_height_and_leaves_room_to_walk_below(height):
    body = plants.tree(height, seeded())
    assert body.size[2] == pytest.approx(height, rel=0.12)
    leaves = body.triangles[body.material == Material.LEAVES].reshape(-1, 3)
    assert leaves[:, 2].min() > 0.3 * height


def test_a_tree_overhangs_to_the_side_asked_for():
    straight, left, right = (plants.tree(7.0, seeded(), overhang) for overhang in (0.0, 2.0, -2.0))
    reach = [body.vertices[:, 1].max() for body in (straight, left)]
    assert reach[1] > reach[0] + 1.0
    assert right.vertices[:, 1].min() < straight.vertices[:, 1].min() - 1.0
    assert left.vertices[left.vertices[:, 2] == 0.0, 1].max() < 0.4, "the trunk stands at the origin"


@pytest.mark.parametrize(("low", "high", "front"), [(10.0, 22.0, 10.0), (-22.0, -10.0, -10.0)])
def test_details_protrude_from_the_side_of_a_building_near_the_street(low, high, front):
    plain = buildings.building((0.0, low, 0.0), (16.0, high, 12.0), GREY)
    detailed = buildings.building((0.0, low, 0.0), (16.0, high, 12.0), GREY, seeded())
    details = detailed.vertices[len(plain.vertices) :]
    outward = (front - details[:, 1]) * np.sign(front)
    assert 0.8 < outward.max() <= 1.3 and outward.min() > -0.2
    assert details[:, 0].min() > -0.5 and details[:, 0].max() < 16.5 and details[:, 2].max() < 12.0


def test_whole_windows_fit_on_every_side_of_a_building():
    body = buildings.building((1.0, 10.7, 0.0), (18.3, 23.1, 11.2), GREY)
    walls = body.texture[np.unique(body.faces[body.material == Material.FACADE])]
    cells = np.ptp(walls, axis=0) / (WINDOW[0], WINDOW[0], WINDOW[1])
    np.testing.assert_allclose(cells, np.round(cells), atol=1e-9)
    np.testing.assert_allclose(walls[:, :2].min(axis=0) / WINDOW[0] % 1.0 % 1.0, 0.0, atol=1e-6)


def test_a_wire_hangs_between_its_ends():
    wire = scenery.overhead_wire((0.0, 0.0, 8.0), (20.0, 3.0, 7.0), sag=0.5)
    x, _, z = wire.vertices.T
    assert x.min() == pytest.approx(0.0, abs=0.02) and x.max() == pytest.approx(20.0, abs=0.02)
    assert z[np.abs(x - 10.0) < 0.5].mean() == pytest.approx(7.0, abs=0.03), "half a metre below the straight line"


def test_signs_have_textures_centred_on_them():
    panel = vehicle_parts.brand_panel((1.0, 2.0, 3.0), (2.0, 2.1, 3.5), RED)
    np.testing.assert_allclose(panel.texture.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.ptp(panel.texture, axis=0), np.ptp(panel.vertices, axis=0))


def test_concatenate_keeps_every_part_and_offsets_faces():
    a, b = ALL["box"](), mesh.ellipsoid((5.0, 0.0, 1.0), (1.0, 1.0, 1.0), Material.LEAVES, GREY)
    both = mesh.concatenate([a, b.classified(SurfaceClass.VEGETATION)])
    np.testing.assert_array_equal(both.triangles, np.concatenate([a.triangles, b.triangles]))
    np.testing.assert_array_equal(both.material, [*a.material, *b.material])
    np.testing.assert_array_equal(both.color, np.concatenate([a.color, b.color]))
    assert set(both.surface_class[len(a.faces) :]) == {SurfaceClass.VEGETATION}


def test_moved_rotates_about_z_and_then_translates():
    body = ALL["box"]()
    moved = body.moved((10.0, 20.0, 1.0), np.pi / 2)
    x, y, z = body.vertices.T
    np.testing.assert_allclose(moved.vertices, np.stack([10.0 - y, 20.0 + x, z + 1.0], axis=1), atol=1e-12)
    assert moved.faces is body.faces and moved.material is body.material and moved.texture is body.texture
