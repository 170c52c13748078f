"""Panels of films and their captions: their places, legible letters, and nothing else changed."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from helpers.hand_made_street import AHEAD, a_format, checkpoint_of, street_model, street_scene

from drivesplat.editing.film import EditFiles, render_edit
from drivesplat.rendering.captions import BEYOND, Caption, captioned, drive_captions, text_mask
from drivesplat.rendering.film import render_film, render_parts
from drivesplat.rendering.panels import MAX_WIDTH, Panels
from drivesplat.scene.splits import last_training_timestamp
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.render import EditJob, FilmJob, TrajectorySettings

HEIGHT, WIDTH = 180, 640


def written(seconds: list[float], labels: list[str], until: float = np.inf, notes: Sequence[str] = ()) -> list:
    """Captions on plain grey."""
    pictures = [np.full((HEIGHT, WIDTH, 3), 90, np.uint8) for _ in seconds]
    panels = Panels(tuple(labels), (WIDTH // len(labels), HEIGHT))
    captions = drive_captions(labels, seconds, until, notes)
    return list(captioned(zip(pictures, captions, strict=True), panels))


def changed(picture: np.ndarray) -> np.ndarray:
    return (picture != 90).any(axis=2)


def test_each_column_has_its_label_at_the_bottom_left_in_white_with_a_dark_outline():
    (picture,) = written([1.0], ["recorded", "stop"])
    lower = changed(picture)[HEIGHT // 2 :]
    columns = np.flatnonzero(lower.any(axis=0))
    assert columns.min() < 12 and not lower[:, WIDTH // 2 - 60 : WIDTH // 2].any()
    assert WIDTH // 2 <= columns[columns >= WIDTH // 2].min() < WIDTH // 2 + 12
    assert not lower[: HEIGHT // 4].any(), "at the bottom"
    assert picture.max() > 220 and picture.min() < 20


def test_seconds_are_at_the_top_right_the_mark_of_frames_beyond_training_left_and_a_note_in_the_last_panel():
    def upper(*arguments, notes: Sequence[str] = ()) -> list[np.ndarray]:
        return [changed(picture)[: HEIGHT // 2] for picture in written(*arguments, notes=notes)]

    first, same, later = upper([1.0, 1.02, 2.0], ["a"])
    assert first[:, -80:].any() and not first[:, : WIDTH // 2].any()
    np.testing.assert_array_equal(first, same)
    assert (first != later).any()
    within, beyond = (shown[:, : WIDTH // 2] for shown in upper([1.0, 1.5], ["a"], 1.2))
    assert not within.any()
    assert np.flatnonzero(beyond.any(axis=0)).max() == pytest.approx(text_mask(BEYOND, 9).shape[1], abs=12)
    without, noted = upper([1.0, 1.0], ["a", "b"], notes=["", "unseen"])
    new = np.flatnonzero((without != noted).any(axis=0))
    assert WIDTH // 2 <= new.min() < WIDTH // 2 + 12 and new.max() < WIDTH // 2 + 120


def test_captions_are_cut_off_where_their_panel_or_the_picture_ends_and_given_pictures_stay():
    (short,), (long,) = (written([1.0], [label, ""]) for label in ("a", "a label as long as the film " * 4))
    different = (short != long).any(axis=(0, 2))
    assert different.any() and not different[WIDTH // 2 :].any()
    given = np.zeros((12, 20, 3), np.uint8)
    (picture,) = captioned([(given, *drive_captions(["a long label"], [1.0], 0.0))], Panels(("a",), (20, 12)))
    assert picture.shape == (12, 20, 3) and picture.any() and not given.any()


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


@pytest.mark.parametrize(
    ("count", "width", "columns", "rows"),
    [(1, 1920, 1, 1), (2, 1920, 2, 1), (3, 576, 3, 1), (3, 1920, 2, 2), (4, 576, 2, 2), (4, 1920, 2, 2), (5, 576, 3, 2),
     (5, 1920, 2, 3), (2, 3840, 1, 2), (2, 7680, 1, 2)],
)  # fmt: skip
def test_a_film_is_as_wide_as_browsers_play_and_each_panel_where_the_record_says(count, width, columns, rows):
    made = Panels(tuple("abcdefg"[:count]), (width, 4))
    assert made.columns == columns and made.film_size == (columns * width, rows * 4)
    assert made.film_size[0] <= max(width, MAX_WIDTH)
    pictures = [np.full((4, width, 3), 10 * (1 + number), np.uint8) for number in range(count)]
    film, record = made.assembled(pictures), made.record()
    assert film.shape == (record["height"], record["width"], 3) and film.dtype == np.uint8
    assert [place["shows"] for place in record["panels"]] == [*made.labels]
    for number, place in enumerate(record["panels"]):
        there = film[place["top"] : place["top"] + 4, place["left"] : place["left"] + width]
        np.testing.assert_array_equal(there, pictures[number])
    assert (film > 0).sum() == count * 4 * width * 3, "places without a panel are black"


@pytest.mark.parametrize(
    ("offset", "words"),
    [
        ({}, "recorded drive, rendered"),
        ({"lateral": 2.0}, "2 m to the left"),
        ({"lateral": -2.5}, "2.5 m to the right"),
        ({"vertical": -0.5, "yaw": -10.0}, "0.5 m down, turned 10 degrees to the right"),
        ({"lateral": -2.0, "vertical": 1.0, "yaw": 10.0}, "2 m to the right, 1 m up, turned 10 degrees to the left"),
        ({"parts": "moving"}, "moving objects alone"),
        ({"parts": "static", "lateral": 3.0}, "without moving objects, 3 m to the left"),
    ],
)
def test_a_trajectory_says_in_words_where_the_camera_is_and_what_it_shows(offset, words):
    assert TrajectorySettings(**offset).in_words == words


def test_films_are_captioned_in_words_beside_the_names_of_the_method_and_the_edit(tiny_scene, tmp_path, monkeypatch):
    scene, checkpoint = street_scene(tiny_scene), checkpoint_of(street_model())
    captions: dict[str, Caption] = {}

    def encoder(path, frames, count, panels, form):
        captions[path.stem] = [caption for _, caption in frames][-1]
        return {}

    monkeypatch.setattr("drivesplat.rendering.film.encode_film", encoder)
    (tmp_path / "street").mkdir()
    form, cpu = a_format(holdout=HoldoutSettings(last_block=2)).model_dump(), DeviceSettings(kind="cpu")
    aside = FilmJob(**form, trajectory=TrajectorySettings(lateral=-2.0))
    render_film(scene, checkpoint, aside, cpu, tmp_path / "street/aside.mp4")
    parts = render_parts(scene, checkpoint, a_format(), cpu, tmp_path / "parts.mp4")
    job = EditJob(**form, edit=Edit.model_validate({"steps": [{"remove": {"track": AHEAD}}]}))
    edit = render_edit(scene, checkpoint, job, cpu, EditFiles(tmp_path / "gone.mp4", tmp_path / "gone.png"))
    assert [*captions["aside"].labels] == ["street: 2 m to the right"]
    assert (captions["aside"].notes[0], captions["aside"].clock) == (BEYOND, "4.5 s")
    assert [*captions["parts"].labels] == ["everything", "without moving objects", "moving objects alone"]
    assert [*captions["gone"].labels] == ["recorded drive, rendered", "edited: gone"]
    shown = [[place["shows"] for place in record["film"]["panels"]] for record in (parts, edit)]
    assert shown == [["everything", "static", "moving"], ["recorded", "gone"]], "records keep the names of panels"
