"""Textures: range of reflectances, filtering by pixel size, reproducibility."""

from itertools import pairwise

import numpy as np
import pytest

from drivesplat.demo.layout import CURB, LANE, ROAD, SIDEWALK
from drivesplat.demo.optics.materials import facade, ground, surface
from drivesplat.demo.optics.patterns import (
    coverage,
    fractal,
    hash_noise,
    plane_fractal,
    plane_noise,
    stripes,
    value_noise,
)
from drivesplat.demo.shapes.mesh import BARK, Material

WALLS = ((0.34, 0.17, 0.11), (0.45, 0.38, 0.27), (0.28, 0.29, 0.31), (0.42, 0.3, 0.22), (0.24, 0.25, 0.2))


@pytest.mark.parametrize("footprint", [0.001, 0.05, 0.3])
@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-0.08, 0.08), (2.0, 2.5)])
def test_coverage_integrates_to_its_width(low, high, footprint):
    x = np.linspace(low - 2.0, high + 2.0, 40_001)
    values = np.array([coverage(v, low, high, footprint) for v in x])
    assert values.min() >= 0.0 and values.max() <= 1.0
    assert values.sum() * (x[1] - x[0]) == pytest.approx(high - low, rel=1e-3)


def test_coverage_is_one_inside_half_at_its_edge_and_none_outside():
    values = [coverage(x, 1.0, 2.0, 0.1) for x in (1.5, 1.0, 2.0, 0.9, 2.1)]
    assert values == pytest.approx([1.0, 0.5, 0.5, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("footprint", [0.001, 0.03, 0.4, 3.0])
def test_stripes_are_the_mean_over_a_pixel(footprint):
    for x in np.linspace(-2.0, 2.0, 37):
        inside = (x + (footprint + 1e-4) * (np.arange(20_000) / 20_000 - 0.5)) % 0.7 < 0.2
        assert stripes(x, 0.7, 0.2, footprint) == pytest.approx(inside.mean(), abs=2e-4)


def hashed(x: int, y: int, z: int) -> float:
    """`hash_noise` with Python's integers."""
    h = (x * 73856093 ^ y * 19349663 ^ z * 83492791) % 2**32
    h = (h ^ (h >> 13)) * 1274126177
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 2**24


def test_hash_noise_is_the_same_every_time():
    for place in np.random.default_rng(0).integers(-1000, 1000, (200, 3)).tolist():
        assert hash_noise(*place) == hash_noise(*map(float, place)) == hashed(*place)


def test_hash_noise_is_uniform_and_neighbours_differ():
    cells = np.array([[hash_noise(x, y, 3) for x in range(-40, 40)] for y in range(-40, 40)])
    assert cells.min() >= 0.0 and cells.max() < 1.0
    assert cells.mean() == pytest.approx(0.5, abs=0.02) and cells.std() == pytest.approx(12**-0.5, abs=0.02)
    for a, b in ((cells[1:], cells[:-1]), (cells[:, 1:], cells[:, :-1])):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.05


def test_value_noise_equals_hash_noise_at_integers_and_is_smooth_between():
    for place in ((2, 3, 4), (-5, 0, 7)):
        assert value_noise(*map(float, place)) == pytest.approx(hash_noise(*place), abs=1e-9)
    line = np.array([value_noise(0.01 * i, 0.3, 0.7) for i in range(1000)])
    assert np.abs(np.diff(line)).max() < 0.02, "smoothstep's slope is at most 1.5"
    assert line.min() >= 0.0 and line.max() < 1.0


def test_plane_noise_is_a_slice_of_value_noise():
    for x, y in np.random.default_rng(2).uniform(-20, 20, (50, 2)):
        assert plane_noise(x, y, 4) == pytest.approx(value_noise(x, y, 4.0), abs=1e-9)


def spread(footprint: float) -> float:
    places = np.random.default_rng(0).uniform(0, 50, (3000, 3))
    return float(np.std([fractal(*place, 1.0, footprint) for place in places]))


def test_fractal_noise_fades_as_pixels_grow_larger_than_it():
    spreads = [spread(footprint) for footprint in (0.001, 0.2, 0.6, 0.9, 1.1)]
    assert spreads[0] > 0.1
    assert all(a > b for a, b in pairwise(spreads))
    assert spreads[-1] == 0.0, "no octave is left"


@pytest.mark.parametrize(("noise", "dimensions"), [(fractal, 3), (plane_fractal, 2)])
def test_fractal_noise_is_centred_and_bounded(noise, dimensions):
    places = np.random.default_rng(1).uniform(-30, 30, (5000, dimensions))
    values = np.array([noise(*place, 0.8, 0.01) for place in places])
    assert abs(values.mean()) < 0.02 and np.abs(values).max() <= 0.875


@pytest.mark.parametrize("material", list(Material))
@pytest.mark.parametrize("footprint", [0.002, 0.1, 2.0])
def test_reflectances_are_in_range(material, footprint):
    random = np.random.default_rng(int(material))
    for _ in range(400):
        x, y, z = random.uniform((-60, -15, 0), (120, 15, 12))
        normal = random.normal(size=3)
        color = random.uniform(0.02, 0.8, 3)
        r, g, b, mirror, emission = surface(int(material), *color, x, y, z, *normal / np.linalg.norm(normal), footprint)
        assert min(r, g, b) >= 0.0 and max(r, g, b) <= 1.5
        assert 0.0 <= mirror <= 1.0 and 0.0 <= emission <= 1.5


def test_only_paint_glass_metal_lamps_and_panes_mirror_and_only_lamps_and_panes_emit():
    found = {
        material: surface(int(material), 0.3, 0.3, 0.3, 5.3, 2.0, 1.0, 0.0, 0.0, 1.0, 0.01)[3:]
        for material in Material
        if material != Material.FACADE
    }
    mirrors = {Material.PAINT, Material.GLASS, Material.METAL, Material.LAMP}
    assert {m for m, (mirror, _) in found.items() if mirror > 0} == mirrors
    assert found[Material.METAL][0] == 0.5
    assert {m for m, (_, emission) in found.items() if emission > 0} == {Material.LAMP}
    pane, wall = (facade(0.3, 0.3, 0.3, 3.2 * u, 3.0 * v, 0.01) for u, v in ((0.3, 0.5), (0.02, 0.05)))  # a shop
    assert pane[3] == pytest.approx(1.0) and pane[4] > 0
    assert wall[3] == 0.0 and wall[4] == 0.0


def test_road_markings_are_lighter_than_the_road_and_the_curb_than_both_grass_and_road():
    road = np.mean([ground(x, 1.7, 0.05)[0] for x in np.arange(0.0, 40.0, 0.13)])
    line = np.mean([ground(x, LANE, 0.05)[0] for x in np.arange(0.0, 40.0, 0.13)])
    curb = np.mean([ground(x, (ROAD + CURB) / 2, 0.05)[0] for x in np.arange(0.0, 40.0, 0.13)])
    assert line > 4 * road and curb > 3 * road
    red, green, blue = np.mean([ground(x, SIDEWALK + 2.5, 0.05) for x in np.arange(0.0, 40.0, 0.13)], axis=0)
    assert green > red > blue


def test_the_middle_line_is_dashed_three_metres_in_six():
    tones = np.array([ground(x, 0.0, 0.02)[0] for x in np.arange(-24.0, 24.0, 0.05)])
    assert (tones > 0.3).mean() == pytest.approx(0.5, abs=0.03)


def sampled(evaluate, footprint: float, low, high, count: int = 5000) -> np.ndarray:
    """Values (count, n) of a texture at random positions between `low` and `high`."""
    places = np.random.default_rng(5).uniform(low, high, (count, len(low)))
    return np.array([evaluate(*place, footprint) for place in places])


@pytest.mark.parametrize(
    ("low", "high", "tolerance"),
    [
        pytest.param((60.0, 0.3), (900.0, 3.2), 0.05, id="asphalt"),
        pytest.param((60.0, LANE - 0.02), (900.0, LANE + 0.02), 0.05, id="marking"),
        pytest.param((60.0, ROAD + 0.03), (900.0, CURB - 0.03), 0.02, id="curb"),
        pytest.param((60.0, CURB + 0.02), (900.0, CURB + 0.45), 0.03, id="small stones"),
        pytest.param((60.0, CURB + 0.6), (900.0, SIDEWALK - 0.1), 0.03, id="slabs"),
        pytest.param((60.0, SIDEWALK + 0.5), (900.0, 60.0), 0.05, id="grass"),
    ],
)
def test_near_and_far_ground_have_the_same_mean(low, high, tolerance):
    near, far = (sampled(ground, footprint, low, high).mean(axis=0) for footprint in (0.002, 0.07))
    np.testing.assert_allclose(near, far, rtol=tolerance)


@pytest.mark.parametrize("color", WALLS)
@pytest.mark.parametrize("floors", [(0.0, 3.0), (3.0, 15.0)], ids=["shops", "windows"])
def test_near_and_far_facades_have_the_same_mean(color, floors):
    def wall(along, z, footprint):
        return facade(*color, along, z, footprint)

    low, high = (0.0, floors[0]), (6400.0, floors[1])
    near, far = (sampled(wall, footprint, low, high, 20_000).mean(axis=0) for footprint in (0.002, 0.5))
    np.testing.assert_allclose(near[:3], far[:3], rtol=0.06)
    np.testing.assert_allclose(near[3:], far[3:], rtol=0.12, err_msg="mirror reflectance and emission")


@pytest.mark.parametrize("material", [Material.PLAIN, Material.LEAVES, Material.CLOTH, Material.METAL, Material.SIGN])
def test_near_and_far_surfaces_of_other_materials_have_the_same_mean(material):
    def textured(x, y, z, footprint):
        return surface(int(material), *BARK, x, y, z, 0.0, 1.0, 0.0, footprint)[:3]

    low, high = (-200.0, -200.0, -1.5), (200.0, 200.0, 1.5)
    near, far = (sampled(textured, footprint, low, high, 20_000).mean(axis=0) for footprint in (0.002, 2.0))
    np.testing.assert_allclose(near, far, rtol=0.06)


@pytest.mark.parametrize(
    ("evaluate", "low", "high"),
    [
        pytest.param(ground, (60.0, 0.3), (900.0, 3.2), id="asphalt"),
        pytest.param(ground, (60.0, CURB + 0.6), (900.0, SIDEWALK - 0.1), id="slabs"),
        pytest.param(ground, (60.0, SIDEWALK + 0.5), (900.0, 60.0), id="grass"),
        pytest.param(lambda x, z, size: facade(*WALLS[0], x, z, size), (0.0, 3.0), (900.0, 12.0), id="facade"),
        pytest.param(
            lambda x, z, size: surface(int(Material.SIGN), 0.1, 0.2, 0.5, x, 0.0, z, 0.0, 1.0, 0.0, size),
            (-50.0, -0.4), (50.0, 0.4), id="sign",
        ),
    ],
)  # fmt: skip
def test_contrast_fades_with_the_size_of_a_pixel(evaluate, low, high):
    spreads = [sampled(evaluate, footprint, low, high)[:, 0].std() for footprint in (0.002, 0.03, 0.3, 3.0)]
    assert all(fine >= 0.99 * coarse for fine, coarse in pairwise(spreads))
    assert spreads[-1] < 0.4 * spreads[0]


def test_near_asphalt_has_details_of_two_centimetres():
    x = np.arange(60.0, 62.0, 0.002)
    near, blurred = (np.array([ground(at, 1.0, footprint)[0] for at in x]) for footprint in (0.002, 0.04))
    step = np.abs(near[10:] - near[:-10]).mean()
    assert step > 0.05 * near.mean() and step > 4 * np.abs(blurred[10:] - blurred[:-10]).mean()


def test_walls_of_different_colours_differ_in_style():
    rows = {}
    for color in WALLS:
        tones = np.array([facade(*color, 0.3, z, 0.002)[0] for z in np.arange(3.1, 3.8, 0.005)]) / color[0]
        rows[color] = np.abs(np.diff(tones)).max()
    assert max(rows.values()) > 0.2, "joints between bricks"
    assert min(rows.values()) < 0.1, "plaster has none"


def test_a_sign_bears_symbols_in_a_contrasting_colour():
    for color, darker in (((0.04, 0.1, 0.4), False), ((0.8, 0.8, 0.8), True)):
        tones = [
            surface(int(Material.SIGN), *color, 0.0, y, 0.0, 1.0, 0.0, 0.0, 0.002)[0] for y in np.arange(0, 3, 0.01)
        ]
        assert (min(tones) < 0.5 * color[0]) if darker else (max(tones) > 3 * color[0])
