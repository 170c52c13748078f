"""What the live viewer shows, without its server."""

import dataclasses

import numpy as np
import pytest
from helpers.hand_made_drive import drive_of
from helpers.hand_made_street import AHEAD, street_model, street_scene

import drivesplat
from drivesplat.drive.live_view import EditSession, FreeCamera, LiveView
from drivesplat.drive.pictures import (
    PICTURES,
    blended,
    depth_picture,
    error_picture,
    name_colors,
    number_colors,
    placed,
)
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError

CAMERA = "CAM_FRONT"


@pytest.fixture(scope="module")
def drive(tiny_scene, tmp_path_factory) -> TrainedDrive:
    return drive_of(street_scene(tiny_scene), street_model(), tmp_path_factory.mktemp("live"))


@pytest.fixture
def view(drive) -> LiveView:
    return LiveView([EditSession(drive)], time=1.0, follow=CAMERA)


@pytest.fixture
def free(view) -> FreeCamera:
    followed = view.followed()
    assert followed is not None
    return followed


def test_a_followed_camera_fills_the_window_in_height(view, free, drive):
    """The principal point of its images is their middle here."""
    np.testing.assert_array_equal(view.picture(free, 64, 48), drive.render(CAMERA, 1.0).image)
    wide = view.picture(free, 128, 48)
    assert wide.shape == (48, 128, 3)
    assert np.abs(wide[:, 32:96].astype(int) - drive.render(CAMERA, 1.0).image).max() <= 1


def test_a_free_camera_fills_the_window(view, free, drive):
    view.follow = None
    beside = free.camera_to_world.copy()
    beside[:3, 3] += 1.0
    found = view.picture(FreeCamera(beside, 0.8), 80, 40)
    focal = 20.0 / np.tan(0.4)
    camera = drivesplat.Camera(80, 40, np.array([[focal, 0.0, 40.0], [0.0, focal, 20.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(found, drive.render(camera, 1.0, camera_to_world=beside).image)


def test_edits_are_seen_and_the_right_half_may_be_another_method(drive, free):
    sessions = [EditSession(drive), EditSession(drive)]
    view = LiveView(sessions, time=1.0, follow=CAMERA)
    before = view.picture(free, 64, 48)
    sessions[1].change(AHEAD, removed=True)
    np.testing.assert_array_equal(view.picture(free, 64, 48), before)
    view.method = 1
    gone = view.picture(free, 64, 48)
    view.method, view.beside = 0, 1
    both = view.picture(free, 64, 48)
    assert not np.array_equal(gone, before)
    np.testing.assert_array_equal(both, np.concatenate([before[:, :32], gone[:, 32:]], axis=1))


def test_the_ego_vehicle_s_edit_moves_the_camera_that_is_followed(view, free):
    view.session.change_ego(2.0, 1.0)
    moved = view.followed()
    assert np.linalg.norm((moved.camera_to_world - free.camera_to_world)[:3, 3]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("shows", [*PICTURES])
def test_every_kind_of_picture_has_the_size_of_the_window(view, free, shows):
    view.shows = shows
    picture = view.picture(free, 64, 48)
    assert picture.dtype == np.uint8 and picture.shape == (48, 64, 3) and len(np.unique(picture)) > 1


def test_errors_and_recorded_images_need_the_image(view, free, drive):
    """The tiny drive's images are those of a street that this model does not show."""
    rendered = view.picture(free, 64, 48)
    view.recorded = 1.0
    recorded = view.picture(free, 64, 48)
    index = view.nearest_image()
    assert drive.scene.seconds(drive.scene.frames[index].timestamp) == pytest.approx(1.0, abs=0.26)
    assert not np.array_equal(rendered, recorded)
    view.recorded, view.shows = 0.0, "error"
    np.testing.assert_array_equal(view.picture(free, 64, 48), error_picture(rendered, recorded))
    gone = dataclasses.replace(
        drive.scene, frames=tuple(dataclasses.replace(f, image_path="missing.jpg") for f in drive.scene.frames)
    )
    nowhere = dataclasses.replace(drive, recording=dataclasses.replace(drive.recording, scene=gone))
    elsewhere = LiveView([EditSession(nowhere)], time=1.0, follow=CAMERA, recorded=1.0)
    np.testing.assert_array_equal(elsewhere.picture(free, 64, 48), rendered)


def test_colours_of_pictures():
    depth = np.array([[0.0, 2.0, 80.0, 500.0]])
    none, near, far, beyond = depth_picture(depth)[0].astype(int)
    assert not none.any() and near[0] > near[2] and far[2] > far[0] and (far == beyond).all()
    assert len(np.unique(number_colors(20), axis=0)) == 20 and number_colors(0).shape == (0, 3)
    np.testing.assert_array_equal(name_colors(["b", "a"])[1], name_colors(["a"])[0])
    black, white = np.zeros((2, 4, 3), np.uint8), np.full((2, 4, 3), 255, np.uint8)
    assert not error_picture(black, black).any() and (error_picture(black, white) == 255).all()
    assert (blended(black, white, 0.5) == 128).all() and (blended(black, white, 0.0) == 0).all()
    shown = placed(white, np.array([2.0, 1.0]), 6, 4)[..., 0] > 0
    assert shown[1:3, 1:5].all() and shown.sum() == 8
    assert (placed(white, np.array([0.0, 0.0]), 6, 4)[..., 0] > 0).sum() == 2 * 3


def test_the_colour_of_paint_is_that_of_the_most_colourful_pixels(view, drive):
    image = drive.render(CAMERA, 1.0, outputs=["rgb", "instance"])
    pixels = image.image[image.arrays()["instance"] == image.objects.index(AHEAD)].astype(int)
    found = view.paint_of(AHEAD)
    assert found is not None
    red, green, blue = (int(found[i : i + 2], 16) for i in (1, 3, 5))
    assert (
        np.abs(pixels - [red, green, blue]).sum(axis=1).min() < 120
        and max(red, green, blue) - min(red, green, blue) > 12
    )
    view.session.change(AHEAD, colour="#1020f0", paint=found)
    assert view.session.steps() == [{"recolour": {"track": AHEAD, "from": found, "colour": "#1020f0"}}]
    assert not np.array_equal(view.session.edited.render(CAMERA, 1.0).image, image.image)
    assert view.paint_of("nobody") is None


def test_methods_of_different_scenes_and_none_are_refused(drive):
    other = dataclasses.replace(drive.scene, name="another")
    elsewhere = dataclasses.replace(drive, recording=dataclasses.replace(drive.recording, scene=other))
    with pytest.raises(RequestError, match="different scenes"):
        LiveView([EditSession(drive), EditSession(elsewhere)])
    with pytest.raises(RequestError, match="no drive"):
        LiveView([])
