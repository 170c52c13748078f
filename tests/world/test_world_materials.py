"""Textures keep their mean, and lose contrast, as pixels grow. Digests hold their values (test_worlds.py)."""

from itertools import pairwise

import numpy as np
import pytest

from drivesplat.world.layout import CURB, LANE, ROAD, SIDEWALK
from drivesplat.world.optics.materials import facade, ground, surface
from drivesplat.world.optics.patterns import (
    coverage,
    hash_noise,
    stripes,
)
from drivesplat.world.shapes.mesh import BARK, Material

WALLS = ((0.34, 0.17, 0.11), (0.45, 0.38, 0.27), (0.28, 0.29, 0.31), (0.42, 0.3, 0.22), (0.24, 0.25, 0.2))


@pytest.mark.parametrize("footprint", [0.001, 0.05, 0.3])
@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-0.08, 0.08), (2.0, 2.5)])
def test_coverage_integrates_to_its_width(low, high, footprint):
    x = np.linspace(low - 2.0, high + 2.0, 40_001)
    values = np.array([coverage(v, low, high, footprint) for v in x])
    assert values.min() >= 0.0 and values.max() <= 1.0
    assert values.sum() * (x[1] - x[0]) == pytest.approx(high - low, rel=1e-3)


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


@pytest.mark.parametrize("color", WALLS[:2])
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
