"""Captions of films: legible letters at their places, and nothing else changed."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from drivesplat.rendering.captions import BEYOND, captioned, drive_captions, text_mask
from drivesplat.rendering.panels import Panels
from drivesplat.scene.splits import last_training_timestamp
from drivesplat.settings.images import HoldoutSettings

HEIGHT, WIDTH = 180, 640


def written(
    seconds: list[float], labels: list[str], trained_until: float = np.inf, notes: Sequence[str] = ()
) -> list[np.ndarray]:
    """Captions on plain grey."""
    pictures = [np.full((HEIGHT, WIDTH, 3), 90, np.uint8) for _ in seconds]
    panels = Panels(tuple(labels), (WIDTH // len(labels), HEIGHT))
    captions = drive_captions(labels, seconds, trained_until, notes)
    return list(captioned(zip(pictures, captions, strict=True), panels))


def changed(picture: np.ndarray) -> np.ndarray:
    return (picture != 90).any(axis=2)


def test_each_column_has_its_label_at_the_bottom_left():
    (picture,) = written([1.0], ["recorded", "stop"])
    lower = changed(picture)[HEIGHT // 2 :]
    columns = np.flatnonzero(lower.any(axis=0))
    assert columns.min() < 12 and not lower[:, WIDTH // 2 - 60 : WIDTH // 2].any()
    assert WIDTH // 2 <= columns[columns >= WIDTH // 2].min() < WIDTH // 2 + 12
    assert not lower[: HEIGHT // 4].any(), "at the bottom"


def test_letters_are_white_with_a_dark_outline():
    (picture,) = written([1.0], ["recorded"])
    assert picture.max() > 220 and picture.min() < 20


def test_the_seconds_of_each_frame_are_at_the_top_right():
    first, same, later = (changed(picture)[: HEIGHT // 2] for picture in written([1.0, 1.02, 2.0], ["a"]))
    assert first[:, -80:].any() and not first[:, : WIDTH // 2].any()
    np.testing.assert_array_equal(first, same)
    assert (first != later).any()


def test_frames_beyond_the_last_training_image_are_marked():
    within, beyond = (changed(picture)[: HEIGHT // 2, : WIDTH // 2] for picture in written([1.0, 1.5], ["a"], 1.2))
    assert not within.any()
    assert np.flatnonzero(beyond.any(axis=0)).max() == pytest.approx(text_mask(BEYOND, 9).shape[1], abs=12)


def test_the_note_of_a_frame_is_in_the_last_panel():
    without, noted = (changed(p)[: HEIGHT // 2] for p in written([1.0, 1.0], ["a", "b"], np.inf, ["", "unseen"]))
    new = np.flatnonzero((without != noted).any(axis=0))
    assert WIDTH // 2 <= new.min() < WIDTH // 2 + 12 and new.max() < WIDTH // 2 + 120


def test_a_long_label_ends_with_its_panel():
    (short,), (long,) = (written([1.0], [label, ""]) for label in ("a", "a label as long as the film " * 4))
    different = (short != long).any(axis=(0, 2))
    assert different.any() and not different[WIDTH // 2 :].any()


def test_the_given_pictures_stay_as_they_are():
    given = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    list(captioned([(given, *drive_captions(["a"], [1.0], 0.0))], Panels(("a",), (WIDTH, HEIGHT))))
    assert (given == 90).all()


def test_captions_larger_than_the_picture_are_cut_off():
    (caption,) = drive_captions(["a long label"], [1.0], 0.0)
    (picture,) = captioned([(np.zeros((12, 20, 3), np.uint8), caption)], Panels(("a",), (20, 12)))
    assert picture.shape == (12, 20, 3) and picture.any()


def test_the_last_training_timestamp_is_that_of_the_last_image_before_the_last_block(tiny_scene):
    keys = [f for f in tiny_scene.frames if f.is_key_frame]
    held = HoldoutSettings(every_nth=0, last_block=2)
    trained = [f.timestamp for f in tiny_scene.frames if f.timestamp < keys[-2].timestamp]
    found = last_training_timestamp(tiny_scene, "CAM_FRONT", held)
    assert keys[-4].timestamp < found <= max(trained)
    none = HoldoutSettings(every_nth=0, last_block=0)
    assert last_training_timestamp(tiny_scene, "CAM_FRONT", none) == tiny_scene.frames[-1].timestamp
    empty = dataclasses.replace(tiny_scene, frames=())
    assert last_training_timestamp(empty, "CAM_FRONT", held) is None
