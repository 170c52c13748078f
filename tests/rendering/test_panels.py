"""Panels of films: their arrangement and their places."""

import numpy as np
import pytest

from drivesplat.rendering.panels import MAX_WIDTH, Panels


def panels(count: int, width: int = 8, height: int = 4) -> Panels:
    return Panels(tuple("abcdefg"[:count]), (width, height))


@pytest.mark.parametrize(
    ("count", "width", "columns", "rows"),
    [(1, 1920, 1, 1), (2, 1920, 2, 1), (3, 576, 3, 1), (3, 1920, 2, 2), (4, 576, 2, 2), (4, 1920, 2, 2), (5, 576, 3, 2),
     (5, 1920, 2, 3), (2, 3840, 1, 2), (2, 7680, 1, 2)],
)  # fmt: skip
def test_a_film_is_as_wide_as_browsers_play(count, width, columns, rows):
    made = panels(count, width, 1080)
    assert made.columns == columns and made.film_size == (columns * width, rows * 1080)
    assert made.film_size[0] <= max(width, MAX_WIDTH)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_each_panel_is_where_the_record_says(count):
    made = panels(count)
    pictures = [np.full((4, 8, 3), 10 * (1 + number), np.uint8) for number in range(count)]
    film, record = made.assembled(pictures), made.record()
    assert film.shape == (record["height"], record["width"], 3) and film.dtype == np.uint8
    assert [place["shows"] for place in record["panels"]] == [*made.labels]
    for number, place in enumerate(record["panels"]):
        there = film[place["top"] : place["top"] + 4, place["left"] : place["left"] + 8]
        np.testing.assert_array_equal(there, pictures[number])
    assert (film > 0).mean() == count * 32 * 3 / film.size


def test_places_without_a_panel_are_black():
    film = panels(5, 1000).assembled([np.full((4, 1000, 3), 255, np.uint8)] * 5)
    assert not film[4:, 2000:].any()
