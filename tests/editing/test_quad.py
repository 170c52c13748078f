"""The film of four panels: recorded images, their reconstruction, the smooth drive, and an edit."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from helpers.hand_made_street import AHEAD, Reels, a_format, checkpoint_of, street_model, street_scene, views_of

from drivesplat.editing.film import EditFiles, render_edit
from drivesplat.editing.quad import recorded_picture, render_quad
from drivesplat.rendering.film import Shot
from drivesplat.rendering.frames import film_frame
from drivesplat.scene.images import read_image
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.render import EditJob, TrajectorySettings
from drivesplat.trajectories.camera_path import film_path

CPU = DeviceSettings(kind="cpu")
STOP = Edit.model_validate({"steps": [{"stop": {"track": AHEAD, "at": 1.0}}]})
LABELS = ["recorded, 2 Hz", "reconstructed, 2 Hz", "smooth, 4 fps", "edited: it"]


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    keys = tuple(frame for frame in tiny_scene.frames if frame.is_key_frame)
    return street_scene(dataclasses.replace(tiny_scene, frames=keys))


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory) -> tuple[dict[str, Any], dict[str, np.ndarray], np.ndarray]:
    """The record, the panels (n, h, w, 3) by their labels, and the film of the same edit."""
    folder, job, checkpoint = tmp_path_factory.mktemp("quad"), a_job(), checkpoint_of(street_model())
    with pytest.MonkeyPatch.context() as patch:
        reels = Reels()
        patch.setattr("drivesplat.rendering.film.write_video", reels)
        record = render_quad(scene, checkpoint, job, CPU, folder / "it.mp4")
        quad = reels["it"]
        render_edit(scene, checkpoint, job, CPU, EditFiles(folder / "it.mp4", folder / "it.png"))
    panels = {
        place["shows"]: quad[:, place["top"] :, place["left"] :][:, :36, :64] for place in record["film"]["panels"]
    }
    return record, panels, reels["it"]


def a_job(**changes: Any) -> EditJob:
    return EditJob(edit=STOP, **a_format(**changes).model_dump())


def test_four_panels_show_the_drive_from_the_recording_to_the_edit(made):
    record, panels, edited = made
    assert list(panels) == LABELS and (record["film"]["width"], record["film"]["height"]) == (128, 72)
    np.testing.assert_array_equal(panels[LABELS[2]], edited[:, :, :64])
    np.testing.assert_array_equal(panels[LABELS[3]], edited[:, :, 64:])
    assert Edit.model_validate(record["edit"]) == STOP and record["frames"] == len(edited) == 19


def test_the_last_recorded_image_and_its_reconstruction_stay_until_the_next(made, scene):
    """Two frames of the film are of each image, which is half as wide as the film's panels."""
    record, panels, _ = made
    recorded, reconstructed = (panels[label] for label in LABELS[:2])
    model, views = street_model(), views_of(record, scene)
    for number, view in enumerate(views):
        np.testing.assert_array_equal(recorded[number], recorded[number // 2 * 2])
        np.testing.assert_array_equal(reconstructed[number], reconstructed[number // 2 * 2])
        if number % 2 == 0:
            shown = film_frame(model, view).astype(int)
            assert np.abs(shown - reconstructed[number]).mean() < 1.0, "at the same place and time as the smooth drive"
    assert (recorded[0] != recorded[2]).any() and (reconstructed[0] != reconstructed[2]).any()


@pytest.mark.parametrize(("width", "height", "fov"), [(96, 54, None), (64, 64, None), (64, 20, None), (96, 54, 40.0)])
def test_a_recorded_image_has_the_intrinsics_of_the_film(scene, width, height, fov):
    """A pixel of the film shows what the image has in the same direction; beyond the image it is black."""
    form = a_format(width=width, height=height, horizontal_fov=fov)
    shot = Shot(scene, film_path(scene, "CAM_FRONT", 4, TrajectorySettings()), form, (width, height))
    frame = scene.frames[2]
    image, picture = read_image(frame.image_path), recorded_picture(frame, shot)
    assert picture.shape == (height, width, 3)
    k = frame.intrinsics
    rows, columns = np.mgrid[2 : height - 2, 2 : width - 2]
    rays = np.linalg.inv(shot.K) @ np.stack([columns + 0.5, rows + 0.5, np.ones_like(rows)]).reshape(3, -1)
    x, y, _ = k @ rays
    inside = (x > 2) & (x < frame.width - 3) & (y > 2) & (y < frame.height - 3)
    there = image[y[inside].round().astype(int), x[inside].round().astype(int)].astype(float)
    shown = picture[2:-2, 2:-2].reshape(-1, 3)
    assert np.abs(shown[inside] - there).mean() < 12.0
    beyond = (y < -2) | (y > frame.height + 1)
    assert not shown[beyond].any() and beyond.any() == (height == 64)
