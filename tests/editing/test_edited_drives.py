"""The edits of a trained scene as samples: objects where the film of the edit has them, and its camera."""

import logging

import numpy as np
import pytest
from helpers.hand_made_street import AHEAD, GONE, TURNING, checkpoint_of, street_model, street_scene

from drivesplat.editing.actors import editable_actors
from drivesplat.editing.ego import edited_camera_path
from drivesplat.editing.sampled_edits import sampled_edits
from drivesplat.settings.edit import Edit
from drivesplat.trajectories.edited_actors import edited_actors


@pytest.fixture(scope="module")
def scene(tiny_scene):
    return street_scene(tiny_scene)


@pytest.fixture(scope="module")
def checkpoint():
    return checkpoint_of(street_model())


def edit_of(*steps: dict) -> Edit:
    return Edit.model_validate({"steps": steps})


STEPS = (
    {"remove": {"track": TURNING}},
    {"duplicate": {"track": GONE, "as": "twin", "lateral": 2.0}},
    {"rescale": {"track": GONE, "factor": 0.5}},
)


def test_objects_are_where_the_film_of_the_edit_has_them(scene, checkpoint):
    edit = edit_of(*STEPS)
    (drive,) = sampled_edits(checkpoint, scene, "CAM_FRONT", {"mixed": edit}, 30)
    expected = {a.id: a for a in edited_actors(editable_actors(street_model(), scene, ""), edit, "")}
    assert drive.name == "mixed" and drive.camera is None
    assert {one.id: (one.source, one.scale) for one in drive.instances} == {
        AHEAD: (AHEAD, 1.0), GONE: (GONE, 0.5), "twin": (GONE, 1.0),
    }  # fmt: skip
    by_id = {one.id: one for one in drive.instances}
    assert by_id[AHEAD].motion is None, "as recorded"
    for name in (GONE, "twin"):
        motion, actor = by_id[name].motion, expected[name]
        assert len(motion.spans) == 2 and np.diff(motion.seconds).min() > 0.0
        np.testing.assert_allclose(motion.object_to_world, actor.poses(motion.seconds), atol=1e-9)
        times = np.linspace(0.0, 4.4, 200)
        inside = np.any([(first <= times) & (times <= last) for first, last in motion.spans], axis=0)
        assert (inside != actor.present(times)).mean() < 0.04, "but for a thirtieth of a second at each end"
    np.testing.assert_allclose(by_id[GONE].size, 0.5 * by_id["twin"].size)


def test_a_changed_ego_vehicle_brings_its_camera(scene, checkpoint):
    edit = edit_of({"ego": {"lateral": 1.5}})
    (drive,) = sampled_edits(checkpoint, scene, "CAM_FRONT", {"aside": edit}, 30)
    path = edited_camera_path(scene, "CAM_FRONT", 30, edit, "")
    np.testing.assert_array_equal(drive.camera.camera_to_world, path.camera_to_world)
    assert drive.camera.seconds[0] == 0.0 and len(drive.camera.seconds) == len(path)
    assert [one.motion for one in drive.instances] == [None] * 3


def test_an_edit_that_does_not_fit_is_left_out_with_a_warning(scene, checkpoint, caplog):
    edits = {"typo": edit_of({"remove": {"track": "abcd"}}), "gone": edit_of({"remove": {"track": GONE}})}
    with caplog.at_level(logging.WARNING):
        drives = sampled_edits(checkpoint, scene, "CAM_FRONT", edits, 30)
    assert [drive.name for drive in drives] == ["gone"]
    (message,) = caplog.messages
    assert "edit 'typo', step 1 (remove)" in message and "abcd" in message
