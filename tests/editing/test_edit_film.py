"""The outputs of an edit: film, still and labels; and refused edits."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.hand_made_street import (
    AHEAD,
    DRIVERS,
    GONE,
    TURNING,
    Reels,
    a_format,
    checkpoint_of,
    street_model,
    views_of,
)
from helpers.samples import sampled_with
from PIL import Image

from drivesplat.editing.actors import warn_of_collisions
from drivesplat.editing.ego import edited_camera_path
from drivesplat.editing.film import EditFiles, Still, render_edit
from drivesplat.errors import ConfigError, DriveSplatError, ResultError
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement
from drivesplat.rendering.film import render_film, write_recorded_frames
from drivesplat.rendering.frames import film_frame
from drivesplat.rendering.panels import Panels
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.render import EditJob, FilmJob, TrajectorySettings
from drivesplat.trajectories.edited_actors import EditedActor, edited_actors
from drivesplat.trajectories.motion import Motion

CPU = DeviceSettings(kind="cpu")
BUSY = [
    {"shift": {"track": AHEAD, "lateral": 2.0}},
    {"duplicate": {"track": "6e5c", "as": "twin", "longitudinal": -6.0}},
    {"remove": {"track": TURNING}},
    {"rescale": {"track": GONE, "factor": 1.3}},
    {"recolour": {"track": "twin", "hue": 120.0}},
]


@dataclass(frozen=True)
class Made:
    """An edit called `it`: its record as another program reads it, its film's frames, and its folder."""

    record: dict[str, Any]
    reels: Reels
    folder: Path

    def pictures(self) -> np.ndarray:
        """The PNGs that the record names, (n, h, w, 3)."""
        return np.stack([np.asarray(Image.open(self.folder / name)) for name in self.record["images"]])

    def track(self, name: str) -> dict[str, Any]:
        return next(track for track in self.record["tracks"] if track["id"] == name)

    @property
    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """The recorded and the edited drive in the film."""
        left, right = np.split(self.reels["it"], 2, axis=2)
        return left, right


def a_job(*steps: dict[str, Any], frames: bool = False, **changes: Any) -> EditJob:
    return EditJob(edit=edit_of(*steps), frames=frames, **a_format(**changes).model_dump())


def edit_of(*steps: dict[str, Any]) -> Edit:
    return Edit.model_validate({"steps": steps})


def files_in(folder: Path) -> EditFiles:
    return EditFiles(folder / "it.mp4", folder / "it.png")


def make(scene: Scene, model: SplatModel, folder: Path, *steps: dict[str, Any], **changes: Any) -> Made:
    with pytest.MonkeyPatch.context() as patch:
        reels = Reels()
        patch.setattr("drivesplat.rendering.film.write_video", reels)
        record = render_edit(scene, checkpoint_of(model), a_job(*steps, **changes), CPU, files_in(folder))
    return Made(json.loads(json.dumps(record, allow_nan=False)), reels, folder)


@pytest.fixture(scope="module")
def busy(scene, model, tmp_path_factory) -> Made:
    """All frames written."""
    return make(scene, model, tmp_path_factory.mktemp("busy"), *BUSY, frames=True)


def test_the_left_half_equals_the_film_of_the_recorded_drive(scene, model, busy, tmp_path, monkeypatch):
    reels = Reels()
    monkeypatch.setattr("drivesplat.rendering.film.write_video", reels)
    job = FilmJob(**a_format(width=64, height=36).model_dump(), trajectory=TrajectorySettings())
    render_film(scene, checkpoint_of(model), job, CPU, tmp_path / "original.mp4")
    np.testing.assert_array_equal(busy.halves[0], reels["original"])


def test_the_left_half_may_come_from_a_file(scene, model, busy, tmp_path, monkeypatch):
    reels, file = Reels(), tmp_path / "recorded_frames.npy"
    monkeypatch.setattr("drivesplat.rendering.film.write_video", reels)
    job, checkpoint = a_job(*BUSY), checkpoint_of(model)
    write_recorded_frames(scene, checkpoint, job, CPU, file)
    record = render_edit(scene, checkpoint, job, CPU, files_in(tmp_path), frames_file=file)
    np.testing.assert_array_equal(reels["it"], busy.reels["it"])
    assert record["tracks"] == busy.record["tracks"] and record["still_frame"] == busy.record["still_frame"]
    np.save(file, 255 - np.load(file))
    render_edit(scene, checkpoint, job, CPU, files_in(tmp_path), frames_file=file)
    assert (reels["it"] != busy.reels["it"]).any()


def test_the_right_half_equals_the_frames_of_the_edited_drive(busy):
    np.testing.assert_array_equal(busy.halves[1], busy.pictures())
    assert (busy.halves[0] != busy.halves[1]).any(axis=(1, 2, 3)).all()


def test_boxes_of_the_labels_are_around_the_objects_in_the_film_and_in_the_frames(scene, model, busy, tmp_path):
    """What the film shows of an object, by the difference from one without it, lies where the record alone puts it."""
    without = make(scene, model, tmp_path, *BUSY, {"remove": {"track": "twin"}}, frames=True)
    record, track = busy.record, busy.track("twin")
    (place,) = (panel for panel in record["film"]["panels"] if panel["shows"] == "it")
    assert busy.reels["it"].shape[1:3] == (record["film"]["height"], record["film"]["width"])
    seen = 0
    for number, pose in enumerate(track["object_to_world"]):
        different = (busy.reels["it"][number] != without.reels["it"][number]).any(axis=-1)
        in_frame = (busy.pictures()[number] != without.pictures()[number]).any(axis=-1)
        low, high = pixel_bounds(record, number, np.array(pose), np.array(track["size"]))
        inside = np.zeros_like(in_frame)
        inside[max(low[1], 0) : max(high[1], 0), max(low[0], 0) : max(high[0], 0)] = True
        assert not (in_frame & ~inside).any()
        filled = in_frame[inside].mean() if inside.any() else 0.0
        film = np.zeros_like(different)
        film[place["top"] :, place["left"] :][: inside.shape[0], : inside.shape[1]] = inside
        assert not (different & ~film).any() and different.sum() == in_frame.sum()
        seen += filled > 0.3
    assert seen > 10


def pixel_bounds(record: dict[str, Any], number: int, pose: np.ndarray, size: np.ndarray) -> tuple[Any, Any]:
    """The first and last column and row that a box covers, two pixels wider."""
    corners = np.array([(x, y, z, 2.0) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.5
    corners[:, :3] *= size + 2 * MARGIN
    in_camera = np.linalg.inv(record["camera_to_world"][number]) @ pose @ corners.T
    if in_camera[2].min() <= 0.1:
        return np.zeros(2, int), np.array([record["width"], record["height"]])
    pixels = (np.array(record["K"]) @ (in_camera[:3] / in_camera[2]))[:2]
    return np.floor(pixels.min(axis=1)).astype(int) - 2, np.ceil(pixels.max(axis=1)).astype(int) + 2


MARGIN = 0.6
"""Metres by which the splats of the model's random Gaussians reach beyond their boxes."""


def test_labels_and_cameras_reproduce_the_frames(scene, model, busy):
    """All actors of the model are at the poses of the labels; bytes differ by at most 1 due to float32 rounding."""
    seen = {track["source"] for track in busy.record["tracks"] if track["editable"]}
    assert seen == {AHEAD, GONE}
    for number, (view, picture) in enumerate(zip(views_of(busy.record, scene), busy.pictures(), strict=True)):
        shown = [
            ActorPlacement(
                track["source"],
                np.array(track["object_to_world"][number]),
                track["scale"],
                track["color_matrix"] and np.array(track["color_matrix"]),
            )
            for track in busy.record["tracks"]
            if track["editable"] and track["object_to_world"][number] is not None
        ]
        again = film_frame(model, view, sampled_with(model, view.time, shown)).astype(int)
        assert np.abs(again - picture).max() <= 1


def test_labels_hold_the_attributes_of_every_object(busy):
    known = {
        track["id"]: [track[key] for key in ("source", "shown_by", "category", "scale", "edited", "editable")]
        for track in busy.record["tracks"]
    }
    assert known == {
        AHEAD: [AHEAD, "own", "vehicle.car", 1.0, True, True],
        "twin": [AHEAD, "own", "vehicle.car", 1.0, True, True],
        GONE: [GONE, "own", "vehicle.truck", 1.3, True, True],
        "0001 instance 1": [None, "none", "vehicle.truck", 1.0, False, False],
        "0001 instance 2": [None, "none", "human.pedestrian.adult", 1.0, False, False],
    }
    np.testing.assert_allclose(busy.track(GONE)["size"], 1.3 * np.array(DRIVERS[GONE].size))
    np.testing.assert_allclose(busy.track("twin")["size"], DRIVERS[AHEAD].size)
    assert busy.track("twin")["color_matrix"] == [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    assert busy.track(AHEAD)["color_matrix"] is None


@pytest.mark.slow
def test_the_caption_says_where_an_object_shows_a_side_that_no_camera_saw(scene, model, tmp_path):
    """The car ahead was seen from behind only; turned round from second 2 on it faces the camera."""
    turn = {"shift": {"track": AHEAD, "yaw": 180.0, "start": 2.0, "duration": 0.0}}
    straight_on = {"shift": {"track": AHEAD, "lateral": 0.1}}

    def noted(step: dict[str, Any]) -> np.ndarray:
        """The frames whose caption has letters at the top left of the edited drive."""
        plain, captioned = (
            make(scene, model, tmp_path, step, width=320, height=180, captions=it).halves[1] for it in (False, True)
        )
        return (plain != captioned)[:, :20, :100].any(axis=(1, 2, 3))

    assert not noted(straight_on).any()
    np.testing.assert_array_equal(noted(turn), 0.25 * np.arange(19) >= 2.0)


@pytest.mark.slow
def test_the_still_is_not_beyond_the_last_training_image(scene, model, tmp_path):
    """With all held out from a second before the largest difference, of a vehicle that falls behind."""
    behind = {"speed": {"track": AHEAD, "factor": 0.5}}

    def still_second(last_block: int) -> float:
        holdout = HoldoutSettings(every_nth=0, last_block=last_block)
        record = make(scene, model, tmp_path, behind, holdout=holdout).record
        return scene.seconds(record["timestamps"][record["still_frame"]])

    held_out = [t for t in scene.key_frame_timestamps if scene.seconds(int(t)) > still_second(0) - 1.0]
    assert 1 < len(held_out) < len(scene.key_frame_timestamps) - 1
    assert still_second(len(held_out)) < scene.seconds(int(held_out[0])) < still_second(0)


def test_a_faster_ego_vehicle_shortens_both_halves(scene, model, tmp_path):
    """The recorded drive goes on beside it at its own speed until the edited film ends."""
    small = {"width": 32, "height": 18}
    made, slow = (make(scene, model, tmp_path, {"ego": {"speed": speed}}, **small) for speed in (1.5, 0.5))
    path = edited_camera_path(scene, "CAM_FRONT", 4, edit_of({"ego": {"speed": 1.5}}), "")
    assert len(made.reels["it"]) == made.record["frames"] == len(path) == 13 and slow.record["frames"] == 19
    np.testing.assert_allclose(made.record["camera_to_world"], path.camera_to_world)
    forward = [np.array(record["camera_to_world"])[:, 0, 3] for record in (made.record, slow.record)]
    np.testing.assert_allclose(forward[0] - forward[0][0], 4.0 * 1.5 * 0.25 * np.arange(13), atol=1e-3)
    np.testing.assert_allclose(forward[1] - forward[1][0], 4.0 * 0.5 * 0.25 * np.arange(19), atol=1e-3)
    np.testing.assert_array_equal(made.halves[0], slow.halves[0][:13])
    frames = made.halves[1]
    assert (frames[-1] != made.halves[0][-1]).mean() > 0.5


def refusal(scene: Scene, model: SplatModel, folder: Path, *steps: dict[str, Any], kind: type[DriveSplatError]) -> str:
    """The message of a refused edit, which must leave no files."""
    with pytest.raises(kind) as caught:
        render_edit(scene, checkpoint_of(model), a_job(*steps, frames=True), CPU, files_in(folder))
    message = str(caught.value)
    assert message.startswith("scene 0001, edit 'it'") and "\n" not in message and not list(folder.iterdir())
    return message


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ([{"reverse": {"track": "ffff"}}],
         ["step 1 (reverse)", "'ffff'", f"editable tracks: {AHEAD}, {TURNING}, {GONE}"]),
        ([{"stop": {"track": "0001 instance 1", "at": 1.0}}], ["no editable track", "'0001 instance 1'"]),
        ([{"remove": {"track": AHEAD}}, {"reverse": {"track": AHEAD}}], ["step 2 (reverse)", "removed by step 1"]),
        ([{"stop": {"track": GONE, "at": 0.1}}], ["step 1 (stop)", "begins after 'at' (0.1 s)", "from 0.29 to 4.29 s"]),
    ],
    ids=["unknown", "parked", "contradiction", "too early"],
)  # fmt: skip
def test_an_edit_that_does_not_fit_is_refused_before_anything_is_written(scene, model, tmp_path, steps, words):
    message = refusal(scene, model, tmp_path, *steps, kind=ConfigError)
    assert all(word in message for word in words), message


def test_a_model_without_actors_cannot_be_edited(scene, model, tmp_path):
    still = street_model(model.parts[0])
    message = refusal(scene, still, tmp_path, *BUSY, kind=ConfigError)
    assert "has no actors" in message and "the method 'street'" in message


def test_actors_missing_in_the_scene_are_refused(scene, model, tmp_path):
    """Otherwise they would silently be missing in the film."""
    other = replace(scene, tracks=tuple(track for track in scene.tracks if track.id != TURNING))
    message = refusal(other, model, tmp_path, {"remove": {"track": AHEAD}}, kind=ResultError)
    assert TURNING in message and "checkpoint.npz" in message


def test_a_still_avoids_collision_frames_unless_there_is_no_other():
    recorded = [np.zeros((2, 2, 3), np.uint8)] * 3
    edited = [np.full((2, 2, 3), value, np.uint8) for value in (10, 200, 90)]
    for avoided, number in (([False, True, False], 2), ([True, True, True], 1)):
        still = Still(Panels(("a", "b"), (2, 2)), np.array(avoided))
        assert len(list(still.pairs(recorded, edited))) == 3
        assert still.number == number


BESIDE = Edit.model_validate({"steps": [{"ego": {"lateral": 1.0}}]})
"""An edit of the camera only."""


def test_a_camera_collides_inside_the_box_of_a_present_actor():
    """A car 4 m long and 2 m wide stands across the world's axes at x = 10, from second 1 on."""
    places = [
        (10.0, 0.0, 0.0),
        (10.0, 0.0, 0.0),
        (10.0, 2.4, 0.0),
        (10.0, 2.6, 0.0),
        (11.4, 0.0, 0.0),
        (11.6, 0.0, 0.0),
    ]
    cameras = np.tile(np.eye(4), (6, 1, 1))
    cameras[:, :3, 3] = places
    seconds = np.array([0.5, 1.0, 2.0, 3.0, 4.0, 5.0])
    across = np.array([[0.0, -1.0, 0.0, 10.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    motion = Motion(seconds[1:], np.tile(across, (5, 1, 1)), ((0, 4),), 0.0)
    car = EditedActor.recorded("a", ObjectClass.CAR, "vehicle.car", np.array([4.0, 2.0, 1.5]), motion)
    found = warn_of_collisions(edited_actors([car], BESIDE, ""), cameras, seconds, "")
    assert found.tolist() == [False, True, True, False, True, False]
