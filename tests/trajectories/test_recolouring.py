"""The colours after `recolour` steps."""

import colorsys

import numpy as np
import pytest

from drivesplat.settings.edit import Recolour
from drivesplat.trajectories.edited_actors import color_matrix

PAINTS = np.array([[0.8, 0.2, 0.1], [0.1, 0.3, 0.6], [0.5, 0.5, 0.5], [0.9, 0.9, 0.2]])


def recoloured(**change) -> np.ndarray:
    return PAINTS @ color_matrix(Recolour(track="x", **change)).T


@pytest.mark.parametrize("degrees", [120.0, -120.0, 240.0])
def test_a_third_of_a_turn_of_the_hue_is_that_of_hsv(degrees):
    hsv = [colorsys.rgb_to_hsv(*paint) for paint in PAINTS]
    expected = [colorsys.hsv_to_rgb((h + degrees / 360) % 1.0, s, v) for h, s, v in hsv]
    np.testing.assert_allclose(recoloured(hue=degrees), expected, atol=1e-12)


@pytest.mark.parametrize("degrees", [30.0, 75.0, 180.0])
def test_any_turn_of_the_hue_keeps_greys_means_and_the_distance_from_grey(degrees):
    found = recoloured(hue=degrees)
    np.testing.assert_allclose(found[2], PAINTS[2])
    np.testing.assert_allclose(found.mean(axis=1), PAINTS.mean(axis=1))
    away = [np.linalg.norm(colors - colors.mean(axis=1, keepdims=True), axis=1) for colors in (found, PAINTS)]
    np.testing.assert_allclose(*away, atol=1e-12)
    turned = [np.arctan2(np.sqrt(3) * (c[:, 1] - c[:, 2]), 2 * c[:, 0] - c[:, 1] - c[:, 2]) for c in (found, PAINTS)]
    turn = np.degrees(turned[0] - turned[1])[[0, 1, 3]] - degrees
    np.testing.assert_allclose((turn + 180) % 360 - 180, 0.0, atol=1e-9)


def test_saturation_and_value_are_factors():
    means = PAINTS.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(recoloured(saturation=1.5), means + 1.5 * (PAINTS - means))
    np.testing.assert_allclose(recoloured(saturation=0.0), np.tile(means, 3))
    np.testing.assert_allclose(recoloured(value=0.5), 0.5 * PAINTS)


def test_a_colour_replaces_that_of_grey_paint_and_keeps_its_shades():
    red = (0.7, 0.1, 0.2)
    found = recoloured(colour=red, value=1.2)
    np.testing.assert_allclose(found, 1.2 * PAINTS.mean(axis=1, keepdims=True) * red)
    assert found[2].argmax() == 0, "a grey car becomes red"


GOLD, BLUE = np.array([0.9, 0.7, 0.1]), (0.1, 0.2, 0.7)


def repainted(colors: np.ndarray, **change) -> np.ndarray:
    return colors @ color_matrix(Recolour.model_validate({"track": "x", "from": tuple(GOLD), **change})).T


@pytest.mark.parametrize("value", [1.0, 0.6])
def test_paint_becomes_another_in_every_shade_while_greys_and_highlights_stay(value):
    greys = np.array([[0.05] * 3, [0.5] * 3, [1.0] * 3])
    np.testing.assert_allclose(repainted(greys, colour=BLUE, value=value), greys, atol=1e-12)
    for shade in (0.2, 1.0):
        paint, new = shade * GOLD, shade * value * np.array(BLUE)
        np.testing.assert_allclose(repainted(paint, colour=BLUE, value=value), new, atol=1e-12)
        np.testing.assert_allclose(repainted(paint + 0.3, colour=BLUE, value=value), new + 0.3, atol=1e-12)


def test_paint_may_become_white_or_black_and_what_it_has_no_part_of_stays():
    for gray in (0.0, 1.0):
        np.testing.assert_allclose(repainted(GOLD, colour=(gray,) * 3), [gray] * 3, atol=1e-12)
    across = np.cross(GOLD - GOLD.mean(), np.ones(3)) * 0.3 + 0.4
    np.testing.assert_allclose(repainted(across, colour=BLUE), across, atol=1e-12)


def test_a_reading_of_the_paint_that_is_too_dark_or_too_bright_only_scales_the_new_paint():
    for factor in (0.5, 1.1):
        matrix = color_matrix(Recolour.model_validate({"track": "x", "from": tuple(factor * GOLD), "colour": BLUE}))
        np.testing.assert_allclose(matrix @ GOLD, np.array(BLUE) / factor, atol=1e-12)
