"""An edit in the making: shifts that place an object, and the edits file that comes out."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made_drive import drive_of
from helpers.hand_made_street import AHEAD, TURNING, street_model, street_scene

from drivesplat.drive.live_view import EditSession, ObjectChange
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.editing.film import edited_frames, edited_shots
from drivesplat.errors import ConfigError, RequestError
from drivesplat.settings.render import EditJob
from drivesplat.workflow.edits_file import read_edits

CAMERA, TIME = "CAM_FRONT", 1.0


@pytest.fixture(scope="module")
def drive(tiny_scene, tmp_path_factory) -> TrainedDrive:
    return drive_of(street_scene(tiny_scene), street_model(), tmp_path_factory.mktemp("session"))


@pytest.fixture
def session(drive) -> EditSession:
    return EditSession(drive)


def pose_of(session: EditSession, track: str) -> np.ndarray:
    return session.edited.state(TIME).actors[track].pose


@pytest.mark.parametrize("track", [AHEAD, TURNING])
def test_an_object_is_placed_where_it_was_dragged_also_on_a_bend(session, track):
    wanted = pose_of(session, track)
    turn = np.radians(25.0)
    wanted[:3, 3] += 1.5 * wanted[:3, 0] - 2.0 * wanted[:3, 1]
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    wanted[:3, :3] = rotation @ wanted[:3, :3]
    session.place(track[:4], wanted, TIME)
    np.testing.assert_allclose(pose_of(session, track)[:2, 3], wanted[:2, 3], atol=0.02)
    np.testing.assert_allclose(pose_of(session, track)[:2, :2], wanted[:2, :2], atol=0.01)
    change = session.change_of(track)
    assert track == TURNING or change.yaw == pytest.approx(25.0, abs=0.5)  # the heading changes along a bend
    session.place(track, wanted, TIME)  # where it stands already
    again = session.change_of(track)
    assert (again.lateral, again.longitudinal) == pytest.approx((change.lateral, change.longitudinal), abs=0.02)


def test_without_changes_the_drive_is_as_recorded(session, drive):
    assert session.steps() == [] and session.edited is drive
    session.change(AHEAD, lateral=1.0)
    assert session.edited is not drive and session.edited is session.edited
    session.reset(AHEAD)
    assert session.edited is drive
    session.change(AHEAD, lateral=1.0)
    session.change(AHEAD, lateral=0.0)
    assert session.changes == {}


def test_the_edits_file_gives_the_picture_that_was_seen(session, tmp_path):
    """The film of the edits file at the time of the picture, from the same camera: the same bytes."""
    session.change(AHEAD, lateral=1.234567, yaw=10.0)
    session.change(TURNING, colour="#c81e1e")
    session.change_ego(0.5, 1.0)
    path = tmp_path / "mine.yaml"
    session.write(path, "mine")
    edit = read_edits(path)["mine"]
    small = {"camera": CAMERA, "width": 64, "height": 36, "fps": 4, "crf": 20, "horizontal_fov": None}
    job = EditJob.model_validate({**small, "edit": edit.model_dump(exclude_none=True)})
    drive = session.drive
    found = edited_shots(drive.scene, drive.model, job, "a test")
    shot, number = found.after, 5
    views = shot.views(torch.device("cpu"))
    frames = list(edited_frames(drive.model, views, found.actors, np.array(shot.seconds)))
    import drivesplat

    camera = drivesplat.Camera(64, 36, shot.K)
    seconds = shot.seconds[number]
    pose = session.edited.camera_to_world(CAMERA, seconds)
    np.testing.assert_allclose(pose, shot.cameras.camera_to_world[number], atol=1e-9)
    image = session.edited.render(camera, seconds, camera_to_world=shot.cameras.camera_to_world[number]).image
    np.testing.assert_array_equal(image, frames[number])
    recorded = drive.render(camera, seconds, camera_to_world=shot.cameras.camera_to_world[number]).image
    assert not np.array_equal(image, recorded)


def test_other_edits_of_the_file_stay_and_comments_are_not_lost(session, tmp_path):
    path = tmp_path / "edits.yaml"
    session.change(AHEAD, removed=True)
    session.write(path, "gone")
    session.change(AHEAD, removed=False, lateral=2.0)
    session.write(path, "aside")
    assert list(read_edits(path)) == ["gone", "aside"]
    session.write(path, "gone")
    assert [step.kind for step in read_edits(path)["gone"].steps] == ["shift"]
    written = path.read_text()
    for commented in ("# mine\n" + written, written.replace("gone:", "gone:  # mine")):
        path.write_text(commented)
        with pytest.raises(RequestError, match="comments"):
            session.write(path, "another")
        assert path.read_text() == commented


def test_a_removed_object_that_is_placed_is_there_again(session):
    wanted = pose_of(session, AHEAD)
    session.change(AHEAD, removed=True)
    assert AHEAD not in session.edited.state(TIME).actors
    session.place(AHEAD, wanted, TIME)
    np.testing.assert_allclose(pose_of(session, AHEAD)[:3, 3], wanted[:3, 3], atol=0.02)


@pytest.mark.parametrize(
    ("call", "error", "word"),
    [
        (lambda session, path: session.change("zz", lateral=1.0), RequestError, "zz"),
        (lambda session, path: session.change("", lateral=1.0), RequestError, "id"),
        (lambda session, path: session.change(AHEAD, lateral=900.0), ConfigError, "lateral"),
        (lambda session, path: session.change(AHEAD, colour="no colour"), ConfigError, "colour"),
        (lambda session, path: session.change_ego(0.0, -1.0), ConfigError, "speed"),
        (lambda session, path: session.place(AHEAD, np.full((4, 4), np.nan), TIME), RequestError, AHEAD),
        (lambda session, path: session.write(path / "edits.yaml", "mine"), RequestError, "nothing"),
    ],
)
def test_what_cannot_be_done_changes_nothing(session, tmp_path, call, error, word):
    with pytest.raises(error, match=word):
        call(session, tmp_path)
    assert session.steps() == [] and not list(tmp_path.iterdir())


def test_the_vehicle_alone_can_be_moved_where_no_object_can(tiny_scene, tmp_path):
    """A method without actors, whose drive has no objects to edit."""
    background = street_model().parts[0]
    session = EditSession(drive_of(street_scene(tiny_scene), street_model(background), tmp_path))
    before = session.edited.camera_to_world(CAMERA, TIME)
    session.change_ego(1.0, 1.0)
    after = session.edited.camera_to_world(CAMERA, TIME)
    assert session.objects == [] and np.linalg.norm((after - before)[:3, 3]) == pytest.approx(1.0, abs=0.05)
    assert not session.edited.render(CAMERA, TIME).objects


def test_another_model_of_the_drive_keeps_the_changes(session, drive):
    session.change(AHEAD, lateral=1.0)
    session.follow(dataclasses.replace(drive))
    assert session.change_of(AHEAD).lateral == 1.0 and session.edited.edit is not None
    session.follow(dataclasses.replace(drive, model=street_model(street_model().parts[0])))
    assert session.changes == {} and session.edited is session.drive


def test_names_that_no_edit_may_have_and_edited_drives_are_refused(session, tmp_path):
    session.change(AHEAD, lateral=1.0)
    for name in ("a b", "a" * 300):
        with pytest.raises(ConfigError, match="a"):
            session.write(tmp_path / "edits.yaml", name)
    assert not list(tmp_path.iterdir())
    with pytest.raises(RequestError, match="recorded"):
        EditSession(session.edited)
    assert dataclasses.asdict(ObjectChange())["removed"] is False
