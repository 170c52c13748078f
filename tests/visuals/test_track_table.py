"""The dynamic objects of a drive as a table and as images with labels."""

import csv
import dataclasses
from collections.abc import Collection

import numpy as np
import pytest
from helpers.hand_made import actor_record, recording_of

from drivesplat.errors import ResultError
from drivesplat.io.array_file import write_arrays
from drivesplat.model.timeline import ActorTrack
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.tracks import MIN_ID_LENGTH, short_ids
from drivesplat.settings.actor_seed import ActorSeedSettings
from drivesplat.trajectories.actor_record import ActorRecords
from drivesplat.trajectories.motion import Motion
from drivesplat.visuals.track_table import (
    MAX_IMAGES,
    covering_images,
    draw_tracks,
    editable_tracks,
    subjects_by_image,
    track_rows,
    write_tracks,
)


@pytest.fixture(scope="module")
def recording(tiny_scene) -> EvaluationData:
    return recording_of(tiny_scene)


def rows_of(recording: EvaluationData, editable: Collection[str] = ()) -> list:
    return track_rows(recording, subjects_by_image(recording, "CAM_FRONT"), editable, ActorSeedSettings())


def test_every_dynamic_object_has_a_row_and_moving_ones_come_first(recording):
    """The tiny street: a car at 4.2 m/s, a walker at 1.2 m/s, a parked truck; a cone cannot move."""
    rows = rows_of(recording)
    by_class = {row.category: row for row in rows}
    assert {row.category: row.moves for row in rows} == {
        "vehicle.car": True, "human.pedestrian.adult": True, "vehicle.truck": False
    }  # fmt: skip
    assert rows[2].category == "vehicle.truck" and len(rows) == 3
    assert by_class["vehicle.car"].speed_mean == pytest.approx(4.2, abs=0.01)
    assert by_class["human.pedestrian.adult"].speed_max == pytest.approx(1.2, abs=0.01)
    truck = by_class["vehicle.truck"]
    assert (truck.length, truck.width, truck.height, truck.speed_max) == (6.0, 2.4, 2.6, 0.0)


def test_times_are_those_of_annotations_and_images(recording, tiny_scene):
    car = next(row for row in rows_of(recording) if row.category == "vehicle.car")
    track = next(track for track in tiny_scene.tracks if track.id == car.id)
    assert car.seconds == pytest.approx((track.timestamps[-1] - track.timestamps[0]) * 1e-6)
    subjects = subjects_by_image(recording, "CAM_FRONT")
    showing = sum(any(s.box.track_id == car.id for s in seen) for seen in subjects.values())
    assert showing == len(track.timestamps) and car.seconds_visible == car.seconds, "in all of it"
    pixels = {
        recording.frame(i).sample_index: s.pixels for i, seen in subjects.items() for s in seen
        if s.box.track_id == car.id
    }  # fmt: skip
    assert car.pixels == max(pixels.values()) == pixels[car.key_frame]


def test_the_table_reads_back(recording, tmp_path):
    rows = rows_of(recording)
    write_tracks(tmp_path / "tracks.csv", rows)
    with open(tmp_path / "tracks.csv", encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert [row["id"] for row in read] == [row.id for row in rows]
    assert [float(row["speed_max"]) for row in read] == [row.speed_max for row in rows]
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultError, match=r"file/tracks\.csv"):
        write_tracks(tmp_path / "file" / "tracks.csv", rows)


def test_editable_tracks_are_those_of_actors_with_points(recording, tmp_path):
    """The car is an actor, the walker has no points, the truck stands."""
    car, walker = (next(row.id for row in rows_of(recording) if row.category.startswith(kind))
                   for kind in ("vehicle.car", "human"))  # fmt: skip
    track = next(track for track in recording.scene.tracks if track.id == car)
    actor = actor_record(ActorTrack(car, track.size, Motion.of_track(recording.scene, track)))
    empty = dataclasses.replace(
        actor, id=walker, lidar_points=0, points=actor.points[:0], points_rgb=actor.points_rgb[:0]
    )
    write_arrays(tmp_path / "actors.npz", ActorRecords([actor, empty]))
    editable = editable_tracks([str(tmp_path / "actors.npz")])
    assert editable == {car} and editable_tracks([]) == set()
    assert {row.category: row.editable for row in rows_of(recording, editable)} == {
        "vehicle.car": True, "human.pedestrian.adult": False, "vehicle.truck": False
    }  # fmt: skip


@pytest.mark.parametrize(
    ("actors", "walker", "car"),
    [
        (ActorSeedSettings(), "class", "never seen"),
        (ActorSeedSettings(classes={"pedestrian": "deformable", "car": "background"}), "never seen", "class"),
        (None, "no method with actors", "no method with actors"),
    ],
    ids=["people are background", "cars are background", "vanilla alone"],
)
def test_a_track_that_cannot_be_edited_says_why(actors, walker, car, recording):
    subjects = subjects_by_image(recording, "CAM_FRONT")
    rows = {row.category: row for row in track_rows(recording, subjects, (), actors)}
    assert {name: row.not_editable for name, row in rows.items()} == {
        "vehicle.car": car, "human.pedestrian.adult": walker, "vehicle.truck": "parked"
    }  # fmt: skip
    ids = [row.id for row in rows.values()]
    assert {row.not_editable for row in track_rows(recording, subjects, ids, actors)} == {""}


def test_labels_are_short_and_unique():
    for ids, length in (
        ([], 0),
        (["a" * 32], MIN_ID_LENGTH),
        (["12345678aa", "12345678ab"], 10),
        (["0123456789", "9123456789"], MIN_ID_LENGTH),
        (["a"], 1),
    ):
        names = short_ids(ids)
        assert list(names) == ids and len(set(names.values())) == len(ids)
        assert all(name.startswith(short) for name, short in names.items())
        assert {len(name) for name in names.values()} <= {length}


def test_without_moving_objects_the_title_says_so(tiny_scene):
    places = (np.repeat(track.object_to_world[:1], len(track.timestamps), axis=0) for track in tiny_scene.tracks)
    tracks = (dataclasses.replace(t, object_to_world=p) for t, p in zip(tiny_scene.tracks, places, strict=True))
    recording = recording_of(dataclasses.replace(tiny_scene, tracks=tuple(tracks)))
    figure = draw_tracks(recording, subjects_by_image(recording, "CAM_FRONT"), rows_of(recording), "CAM_FRONT")
    assert "nothing moves" in figure.get_suptitle() and len(figure.axes) == 1 and not figure.axes[0].texts


def test_few_images_cover_all_objects():
    for pixels, expected in (
        ({}, []),
        ({4: {}}, []),
        ({0: {"a": 5}, 1: {"a": 9}}, [1]),
        ({0: {"a": 5, "b": 5}, 1: {"a": 900}}, [0]),
        ({0: {"a": 1}, 1: {"b": 1}, 2: {"a": 1, "c": 1}}, [1, 2]),
        ({i: {str(i): 1} for i in range(9)}, list(range(MAX_IMAGES))),
    ):
        assert covering_images(pixels) == expected
