"""Textures: range of reflectances, filtering by pixel size, reproducibility."""

from itertools import pairwise

import numpy as np
import pytest

from drivesplat.demo.materials import coverage, facade, fractal, ground, hash_noise, surface, value_noise
from drivesplat.demo.meshes import Material


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


def spread(footprint: float) -> float:
    places = np.random.default_rng(0).uniform(0, 50, (3000, 3))
    return float(np.std([fractal(*place, 1.0, footprint) for place in places]))


def test_fractal_noise_fades_as_pixels_grow_larger_than_it():
    spreads = [spread(footprint) for footprint in (0.001, 0.2, 0.6, 0.9, 1.1)]
    assert spreads[0] > 0.1
    assert all(a > b for a, b in pairwise(spreads))
    assert spreads[-1] == 0.0, "no octave is left"


def test_fractal_noise_is_centred_and_bounded():
    places = np.random.default_rng(1).uniform(-30, 30, (5000, 3))
    values = np.array([fractal(*place, 0.8, 0.01) for place in places])
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


def test_only_paint_glass_lamps_and_panes_mirror_and_only_lamps_and_panes_emit():
    found = {
        material: surface(int(material), 0.3, 0.3, 0.3, 5.3, 2.0, 1.0, 0.0, 0.0, 1.0, 0.01)[3:]
        for material in Material
        if material != Material.FACADE
    }
    assert {m for m, (mirror, _) in found.items() if mirror > 0} == {Material.PAINT, Material.GLASS, Material.LAMP}
    assert {m for m, (_, emission) in found.items() if emission > 0} == {Material.LAMP}
    pane, wall = (facade(0.3, 0.3, 0.3, 3.2 * u, 3.0 * v, 0.01) for u, v in ((0.3, 0.5), (0.02, 0.05)))
    assert pane[3] == pytest.approx(1.0) and pane[4] > 0
    assert wall[3] == 0.0 and wall[4] == 0.0


def test_road_markings_are_lighter_than_the_road_and_the_curb_than_both_grass_and_road():
    road = np.mean([ground(x, 1.7, 0.05)[0] for x in np.arange(0.0, 40.0, 0.13)])
    line = np.mean([ground(x, 3.5, 0.05)[0] for x in np.arange(0.0, 40.0, 0.13)])
    curb = np.mean([ground(x, 6.0, 0.05)[0] for x in np.arange(0.0, 40.0, 0.13)])
    assert line > 4 * road and curb > 3 * road
    red, green, blue = np.mean([ground(x, 12.0, 0.05) for x in np.arange(0.0, 40.0, 0.13)], axis=0)
    assert green > red > blue


def test_the_middle_line_is_dashed_three_metres_in_six():
    tones = np.array([ground(x, 0.0, 0.02)[0] for x in np.arange(-24.0, 24.0, 0.05)])
    assert (tones > 0.3).mean() == pytest.approx(0.5, abs=0.03)


def test_far_ground_is_the_mean_of_near_ground():
    near = np.mean([ground(x, y, 0.01)[0] for x in np.arange(55, 65, 0.07) for y in np.arange(0.5, 3.0, 0.1)])
    far = ground(60.0, 1.7, 30.0)[0]
    assert far < 0.3 and near == pytest.approx(0.085, rel=0.25)
