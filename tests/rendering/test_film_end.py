"""Where films end: at the last training image, or at the last recorded one, and all films of a drive alike."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers.hand_made import recording_of
from helpers.hand_made_street import AHEAD, Reels, a_format, checkpoint_of, street_model, street_scene

from drivesplat.editing.film import EditFiles, render_edit
from drivesplat.editing.quad import render_quad
from drivesplat.rendering.film import render_film, render_parts
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import last_training_timestamp
from drivesplat.settings.config import Config
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.render import CompareJob, EditJob, FilmJob, TrajectorySettings
from drivesplat.visuals.compare import render_comparison
from drivesplat.workflow.stages import stage_settings

CPU, CAMERA = DeviceSettings(kind="cpu"), "CAM_FRONT"
HELD = HoldoutSettings(every_nth=0, last_block=3)
"""Of ten key frames, every half second, the last three."""
LATE = {"stop": {"track": AHEAD, "at": 3.5}}


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    return street_scene(tiny_scene)


@pytest.fixture
def reels(monkeypatch) -> Reels:
    made = Reels()
    monkeypatch.setattr("drivesplat.rendering.film.write_video", made)
    return made


def edit_job(end: str, *steps: dict[str, Any], holdout: HoldoutSettings = HELD) -> EditJob:
    edit = Edit.model_validate({"steps": [{"shift": {"track": AHEAD, "lateral": 1.0}}, *steps]})
    return EditJob(edit=edit, **a_format(end=end, holdout=holdout).model_dump())


def lengths(scene: Scene, folder: Path, reels: Reels, end: str, holdout: HoldoutSettings = HELD) -> list[int]:
    """The numbers of frames of a trajectory, of parts, of an edit and of its four panels, as films and records agree
    on them."""
    checkpoint, form = checkpoint_of(street_model()), a_format(end=end, holdout=holdout)
    job = FilmJob(**form.model_dump(), trajectory=TrajectorySettings(lateral=1.0))
    edit, files = edit_job(end, holdout=holdout), EditFiles(folder / "edit.mp4", folder / "edit.png")
    records = {
        "film": render_film(scene, checkpoint, job, CPU, folder / "film.mp4"),
        "parts": render_parts(scene, checkpoint, form, CPU, folder / "parts.mp4"),
        "edit": render_edit(scene, checkpoint, edit, CPU, files),
        "quad": render_quad(scene, checkpoint, edit, CPU, folder / "quad.mp4"),
    }
    for name, record in records.items():
        assert len(reels[name]) == record["frames"] == len(record["timestamps"]) == len(record["camera_to_world"])
    assert len({tuple(record["timestamps"]) for record in records.values()}) == 1, "they stay in step"
    return [record["frames"] for record in records.values()]


def test_films_of_a_drive_end_together_at_the_last_training_image_or_at_the_last_recorded_one(scene, tmp_path, reels):
    last = last_training_timestamp(scene, CAMERA, HELD)
    seconds = scene.seconds(last)
    assert 2.0 < seconds < 3.5
    assert lengths(scene, tmp_path, reels, "recorded") == [19] * 4
    assert lengths(scene, tmp_path, reels, "trained") == [int(4 * seconds + 1e-6) + 1] * 4


def test_films_of_a_drive_that_was_trained_on_completely_or_not_at_all_go_to_its_end(scene, tmp_path, reels):
    whole = HoldoutSettings(every_nth=0, last_block=0)
    assert lengths(scene, tmp_path, reels, "trained", whole) == [19] * 4
    beside = HoldoutSettings(every_nth=0, last_block=3, cameras=(CAMERA,))
    assert last_training_timestamp(scene, CAMERA, beside) is None
    assert lengths(scene, tmp_path, reels, "trained", beside) == [19] * 4


@pytest.mark.parametrize(("end", "warned"), [("trained", True), ("recorded", False)])
def test_a_step_that_begins_after_the_end_of_the_film_is_named(scene, tmp_path, reels, caplog, end, warned):
    files = EditFiles(tmp_path / "brake.mp4", tmp_path / "brake.png")
    with caplog.at_level(logging.WARNING):
        render_edit(scene, checkpoint_of(street_model()), edit_job(end, LATE), CPU, files)
    found = [record.getMessage() for record in caplog.records if "render: {end: recorded}" in record.getMessage()]
    assert len(found) == warned
    if warned:
        assert found[0].startswith("scene 0001, edit 'brake', step 2 (stop): it begins at 3.5 s")


@pytest.mark.parametrize(
    ("step", "second"),
    [
        ({"remove": {"track": AHEAD}}, 0.0), ({"stop": {"track": AHEAD, "at": 2.0}}, 2.0),
        ({"shift": {"track": AHEAD, "lateral": 1.0}}, 0.0), ({"ego": {"lateral": 1.0, "start": 1.5}}, 1.5),
        ({"place": {"track": AHEAD, "as": "b", "path": [[3.0, 9.0, 0.0]]}}, 3.0),
        ({"place": {"track": AHEAD, "as": "b", "path": [[-3.0, 9.0, 0.0], [1.0, 12.0, 0.0]]}}, 0.0),
    ],
)  # fmt: skip
def test_a_step_knows_the_second_from_which_on_it_changes_something(step, second):
    assert Edit.model_validate({"steps": [step]}).steps[0].begins == second


@pytest.mark.parametrize(("end", "last_block", "count"), [("trained", 2, 8), ("recorded", 2, 10), ("trained", 0, 10)])
def test_all_methods_side_by_side_end_where_the_other_films_do(scene, tmp_path, reels, end, last_block, count):
    keys = tuple(frame for frame in scene.frames if frame.is_key_frame)
    recording = recording_of(replace(scene, frames=keys), width=40, every_nth=0, last_block=last_block)
    job = CompareJob(eval_camera=CAMERA, crf=18, captions=False, end=end)
    record = render_comparison({"a": checkpoint_of(street_model())}, recording, job, CPU, tmp_path / "compare.mp4")
    assert len(reels["compare"]) == record["frames"] == len(record["images"]) == count
    assert (record["images"][-1]["split"] == "extrapolation") == (end == "recorded")


def test_the_setting_reruns_films_of_images_and_no_others():
    def settings(stage: str, end: str) -> str:
        config = Config.model_validate({"render": {"end": end}})
        film = {"film": "original", "edit": "stop", "quad": "stop", "drive_folder": "edits/stop"}.get(stage)
        return stage_settings(config, stage, "demo", "street", film)

    ends = {
        stage: settings(stage, "trained") != settings(stage, "recorded")
        for stage in ("film", "film_parts", "compare", "edit", "quad", "truth_film", "lidar_film", "drive_folder",
                      "export_viewer", "evaluate", "train")
    }  # fmt: skip
    assert [stage for stage, differs in ends.items() if differs] == ["film", "film_parts", "compare", "edit", "quad"]
