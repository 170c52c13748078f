"""Meshes of the demo world: closed, oriented outward, on the ground, of the stated size."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from drivesplat.demo import meshes
from drivesplat.demo.meshes import ColoredMesh, Material

RED = (0.5, 0.1, 0.1)
GREY = (0.3, 0.3, 0.3)
CAR_SIZE, VAN_SIZE = (4.5, 1.85, 1.5), (5.4, 2.05, 2.5)
SHAPES: dict[str, Callable[[], ColoredMesh]] = {
    "box": lambda: meshes.box((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0), Material.PLAIN, RED),
    "cylinder": lambda: meshes.cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 0.5, Material.PLAIN, RED),
    "ball": lambda: meshes.ellipsoid((0.0, 0.0, 1.0), (1.0, 0.5, 1.0), Material.PLAIN, RED),
    "car": lambda: meshes.car(CAR_SIZE, RED),
    "van": lambda: meshes.van(VAN_SIZE, RED),
    "pedestrian": lambda: meshes.pedestrian(1.75, RED, GREY, 1.0),
    "standing pedestrian": lambda: meshes.pedestrian(1.6, RED, GREY, 0.0),
    "tree": lambda: meshes.tree(7.0, np.random.default_rng(3)),
    "building": lambda: meshes.building((0.0, 10.0, 0.0), (12.0, 22.0, 9.0), GREY),
    "street lamp": lambda: meshes.street_lamp(6.5, -1.5),
    "sign": lambda: meshes.sign(RED),
    "cone": meshes.cone,
}  # fmt: skip


@pytest.fixture(params=SHAPES)
def body(request) -> ColoredMesh:
    return SHAPES[request.param]()


def test_every_part_is_closed_and_faces_outward(body):
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=True)
    parts = mesh.split(only_watertight=False)
    assert len(parts) >= 1
    for part in parts:
        assert part.is_watertight and part.volume > 0


def test_meshes_stand_on_the_ground(body):
    assert body.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert body.vertices[:, 2].min() >= -1e-9


def test_size_is_that_of_the_box_around_the_origin(body):
    half = body.size[:2] / 2
    assert (np.abs(body.vertices[:, :2]) <= half + 1e-12).all() and body.vertices[:, 2].max() == body.size[2]
    assert np.abs(body.vertices[:, 0]).max() == pytest.approx(half[0])
    assert np.abs(body.vertices[:, 1]).max() == pytest.approx(half[1])


def test_every_face_has_a_material_and_a_colour(body):
    assert body.faces.shape == (len(body.material), 3) and body.color.shape == body.faces.shape
    assert set(body.material.tolist()) <= {int(material) for material in Material}
    assert body.color.min() >= 0.0 and body.color.max() <= 1.0
    assert body.faces.min() == 0 and body.faces.max() == len(body.vertices) - 1
    assert body.triangles.shape == (len(body.faces), 3, 3)


@pytest.mark.parametrize(
    ("shape", "volume"),
    [("box", 2.0 * 4.0 * 3.0), ("cylinder", np.pi * 0.25 * 2.0), ("ball", 4 / 3 * np.pi * 0.5)],
)
def test_primitives_have_their_volume(shape, volume):
    body = SHAPES[shape]()
    found = trimesh.Trimesh(body.vertices, body.faces).volume
    assert 0.9 * volume < found <= volume + 1e-9, "round solids are inscribed polyhedra"


@pytest.mark.parametrize(("make", "size"), [(meshes.car, CAR_SIZE), (meshes.van, VAN_SIZE)])
def test_vehicles_have_the_size_asked_for_but_for_lights_that_stick_out_two_centimetres(make, size):
    found = make(size, RED).size
    assert size[0] <= found[0] <= size[0] + 0.04 + 1e-9
    np.testing.assert_allclose(found[1:], size[1:], atol=1e-9)


@pytest.mark.parametrize("make", [meshes.car, meshes.van])
def test_vehicles_have_paint_glass_lights_and_tyres(make):
    body = make((4.6, 1.9, 1.8), RED)
    for material in (Material.PAINT, Material.GLASS, Material.LAMP, Material.PLAIN):
        assert (body.material == material).any()
    assert (body.color[body.material == Material.PAINT] == RED).all()
    lights, rear = body.material == Material.LAMP, body.triangles[:, :, 0].max(axis=1) < 0
    assert (body.color[lights & rear] == meshes.TAIL_LIGHT).all()
    assert (body.color[lights & ~rear] == meshes.HEADLIGHT).all()


def test_concatenate_keeps_every_part_and_offsets_faces():
    a, b = SHAPES["box"](), meshes.ellipsoid((5.0, 0.0, 1.0), (1.0, 1.0, 1.0), Material.LEAVES, GREY)
    both = meshes.concatenate([a, b])
    np.testing.assert_array_equal(both.triangles, np.concatenate([a.triangles, b.triangles]))
    np.testing.assert_array_equal(both.material, [*a.material, *b.material])
    np.testing.assert_array_equal(both.color, np.concatenate([a.color, b.color]))


def test_moved_rotates_about_z_and_then_translates():
    body = SHAPES["box"]()
    moved = body.moved((10.0, 20.0, 1.0), np.pi / 2)
    x, y, z = body.vertices.T
    np.testing.assert_allclose(moved.vertices, np.stack([10.0 - y, 20.0 + x, z + 1.0], axis=1), atol=1e-12)
    assert moved.faces is body.faces and moved.material is body.material


def test_a_stride_swings_the_legs_apart():
    standing, walking = (meshes.pedestrian(1.75, RED, GREY, stride) for stride in (0.0, 1.0))
    assert walking.size[0] > standing.size[0] + 0.4
    assert meshes.pedestrian(1.75, RED, GREY, -1.0).size[0] == pytest.approx(walking.size[0], abs=0.02)
