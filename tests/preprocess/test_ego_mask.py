"""Detection of the ego vehicle's body: from the user's outlines, or from pixels that stay constant along the drive."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import drives
from helpers.rig_drives import KEY_FRAMES, rig_drive, true_body
from PIL import Image

from drivesplat.errors import ResultError
from drivesplat.preprocess import ego_mask as search_module
from drivesplat.preprocess.ego_mask import (
    ComparedImages,
    camera_outlines,
    ego_mask_record,
    find_outlines,
    outlines_of,
)
from drivesplat.scene.ego_mask import enclosed, read_ego_mask
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import frame_groups
from drivesplat.settings.config import load
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.masks import EgoMaskJob, EgoMaskSearch
from drivesplat.workflow.stages import stage_settings

CAMERAS = ("CAM_BACK", "CAM_FRONT")


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> Scene:
    """A drive of 14 key frames and 50 m, in which CAM_BACK sees the ego vehicle's rear."""
    return rig_drive(tmp_path_factory.mktemp("seen"), CAMERAS, own_car=True)


@pytest.fixture(scope="module")
def unseen(tmp_path_factory) -> Scene:
    """The same drive, in which no camera sees the ego vehicle."""
    return rig_drive(tmp_path_factory.mktemp("unseen"), CAMERAS[:1])


SIZE = (160, 90)
NOTHING_HELD_OUT = HoldoutSettings(every_nth=0, last_block=0)
LOOKING = EgoMaskSearch(cameras=CAMERAS, holdout=NOTHING_HELD_OUT, own_car_radius=2.5)
JOB = EgoMaskJob(polygons={}, search=LOOKING)


def painted(scene: Scene, folder: Path, paint: Callable[[np.ndarray, int], np.ndarray]) -> Scene:
    """A scene whose images of CAM_BACK are changed by `paint(pixels, number)`."""
    frames, number = [], 0
    for frame in scene.frames:
        if frame.camera == "CAM_BACK":
            path = folder / f"{number}.png"
            pixels = paint(np.asarray(Image.open(frame.image_path)).astype(float), number)
            Image.fromarray(np.clip(pixels + 0.5, 0, 255).astype(np.uint8)).save(path)
            frame, number = dataclasses.replace(frame, image_path=str(path)), number + 1
        frames.append(frame)
    return dataclasses.replace(scene, frames=tuple(frames))


def body_in(scene: Scene, camera: str = "CAM_BACK", search: EgoMaskSearch = LOOKING) -> np.ndarray:
    """The pixels (h, w) bool that are detected as the ego vehicle's body."""
    outlines, _, why = camera_outlines(scene, camera, EgoMaskJob(polygons={}, search=search))
    assert (why is None) == bool(outlines)
    return enclosed(outlines, SIZE)


def reason_without_body(scene: Scene, camera: str = "CAM_BACK") -> str:
    outlines, source, why = camera_outlines(scene, camera, JOB)
    assert (outlines, source) == ((), None)
    return why


def assert_is_the_body(found: np.ndarray) -> None:
    true = true_body("CAM_BACK")
    assert 0.04 < true.mean() < 0.08
    assert (found & true).sum() > 0.9 * true.sum()
    assert (found & true).sum() > 0.75 * (found | true).sum()


def test_the_detected_body_matches_the_true_one(seen, unseen):
    assert_is_the_body(body_in(seen))
    assert not true_body("CAM_FRONT").any() and not body_in(seen, "CAM_FRONT").any()
    assert reason_without_body(unseen)


def test_a_body_under_changing_light_is_found(seen, tmp_path):
    """The brightness of the body alone varies by a quarter."""
    body, light = true_body("CAM_BACK")[..., None], np.random.default_rng(0).uniform(0.75, 1.25, KEY_FRAMES)
    lit = painted(seen, tmp_path, lambda pixels, number: np.where(body, 0.8 * light[number] * pixels, pixels))
    assert_is_the_body(body_in(lit))


def test_held_out_images_and_sweeps_contribute_nothing(seen, tmp_path):
    """Held-out images become noise and held-out sweeps get returns on the body: no pixel changes. Two training sweeps
    are missing, so that held-out ones, 4 m away, are the nearest to their images."""
    search = LOOKING.model_copy(update={"holdout": HoldoutSettings(every_nth=6, offset=3, last_block=0)})
    groups = frame_groups(seen, search.holdout)
    held_out = {f.sample_index for f, group in zip(seen.frames, groups, strict=True) if group != "train"}
    assert held_out == {3, 9}
    sweeps = [sweep for sweep in seen.sweeps if sweep.sample_index not in (4, 10)]
    before = body_in(dataclasses.replace(seen, sweeps=tuple(sweeps)), search=search)
    assert before.any()
    on_body = np.random.default_rng(0).uniform((-3, -5.2, -4.1, 1, 1), (3, -4.7, -3.8, 1, 1), (900, 5))
    on_body.astype(np.float32).tofile(tmp_path / "garbage.bin")
    sweeps = [
        dataclasses.replace(sweep, path=str(tmp_path / "garbage.bin")) if sweep.sample_index in held_out else sweep
        for sweep in sweeps
    ]
    noise = np.random.default_rng(0).uniform(0, 255, (90, 160, 3))
    spoilt = painted(seen, tmp_path, lambda pixels, number: noise if number in held_out else pixels)
    np.testing.assert_array_equal(body_in(dataclasses.replace(spoilt, sweeps=tuple(sweeps)), search=search), before)
    assert (body_in(dataclasses.replace(seen, sweeps=tuple(sweeps))) != before).any(), "training sweeps do contribute"


def even_below(row: int, grey: float) -> Callable[[np.ndarray, int], np.ndarray]:
    return lambda pixels, _: np.where(np.arange(90)[:, None, None] > row, grey, pixels)


def test_drives_that_tell_nothing_of_the_body_are_refused_with_the_reason(seen, tmp_path):
    """Of nine images, over which the vehicle moves 9 m, the number is named, not the path."""
    few = dataclasses.replace(seen, frames=tuple(frame for frame in seen.frames if frame.sample_index < 9))
    dark = painted(seen, tmp_path, lambda pixels, _: 0.05 * pixels)
    still = tuple(dataclasses.replace(f, camera_to_world=seen.frames[0].camera_to_world,
                                      ego_to_world=seen.frames[0].ego_to_world) for f in seen.frames)  # fmt: skip
    for scene, words in (
        (dataclasses.replace(seen, frames=still), "too short a path: 1 images"),
        (few, "too few images: 9 for training; 10 are needed"),
        (dataclasses.replace(seen, sweeps=()), "0 images have LiDAR"),
        (dark, "too little to detect"),
    ):
        assert words in reason_without_body(scene)


def test_an_even_road_and_a_constant_area_that_is_too_large_are_not_a_body(unseen, tmp_path):
    """The road near the camera becomes one grey, up to a line that stays where it is."""
    even = painted(unseen, tmp_path, even_below(75, 90.0))
    assert reason_without_body(even) == "LiDAR has returns all along the edge of the images"
    path = tmp_path / "far.bin"
    np.array([[0.0, 0.0, 90.0, 1.0, 1.0]], dtype=np.float32).tofile(path)
    missed = tuple(dataclasses.replace(sweep, path=str(path)) for sweep in unseen.sweeps)
    larger = painted(dataclasses.replace(unseen, sweeps=missed), tmp_path, even_below(60, 120.0))
    assert "more than a body fills" in reason_without_body(larger)


def test_images_at_a_standstill_are_left_out(seen):
    """Thirty more images taken at a standstill, in which every pixel is constant."""
    at_standstill = [frame for frame in seen.frames if frame.camera == "CAM_BACK" and frame.sample_index == 5]
    more = [dataclasses.replace(at_standstill[0], timestamp=at_standstill[0].timestamp + i) for i in range(1, 31)]
    scene = dataclasses.replace(seen, frames=(*seen.frames, *more))
    assert len(ComparedImages.of(scene, "CAM_BACK", LOOKING).frames) == KEY_FRAMES
    np.testing.assert_array_equal(body_in(scene), body_in(seen))


def test_an_outline_of_the_user_replaces_the_search_in_its_camera_only(seen):
    outline = ((0.0, 0.9), (1.0, 0.9), (1.0, 1.0))
    for searched in (("CAM_FRONT",), ()):
        search = LOOKING.model_copy(update={"cameras": searched})
        cameras = ego_mask_record(seen, EgoMaskJob(polygons={"CAM_BACK": outline}, search=search))["cameras"]
        given, other = cameras["CAM_BACK"], cameras["CAM_FRONT"]
        assert (given["source"], given["outlines"], given["why_null"]) == ("polygons", (outline,), None)
        assert given["share"] == pytest.approx(0.05, abs=0.002)
        assert other["why_null"] and ("not searched" in other["why_null"]) is not bool(searched)


def test_a_setting_chooses_the_cameras_to_search():
    """CAM_FRONT is evaluated; CAM_BACK has a given outline."""
    for kind, outlined, searched in (
        ("none", [], None),
        ("polygons", ["CAM_BACK"], None),
        ("auto", ["CAM_BACK"], ("CAM_BACK_RIGHT",)),
        ("auto_measured", ["CAM_BACK"], ("CAM_FRONT", "CAM_BACK_RIGHT")),
    ):
        masks = {"own_car": kind, "own_car_polygons": {"CAM_BACK": [[0, 1], [1, 1], [0.5, 0.9]]}}
        values = {"cameras": ["CAM_FRONT", "CAM_BACK", "CAM_BACK_RIGHT"], "masks": masks}
        job = EgoMaskJob.model_validate_json(stage_settings(load(values), "own_car", "0061"))
        assert list(job.polygons) == outlined and (job.search and job.search.cameras) == searched


def test_a_foreign_record_is_named_with_its_rule(tmp_path):
    path = tmp_path / "own_car.json"
    for content in (None, "", "[]", "{}", '{"cameras": {"A": {}}, "provenance": {}}', '{"cameras": {}}'):
        if content is not None:
            path.write_text(content)
        with pytest.raises(ResultError, match=r"own_car\.json.*'own_car'"):
            read_ego_mask(path)


def test_each_of_two_bodies_has_its_outline():
    mask = np.zeros((90, 160), dtype=bool)
    mask[80:, :30] = mask[80:, 130:] = True
    assert len(outlines_of(mask)) == 2


def test_no_body_is_found_in_the_front_camera_of_a_real_drive(real_scene_root, monkeypatch):
    """This holds even without any LiDAR returns: the road varies too much to be detected as a body."""
    scene = drives.scene_at(real_scene_root, dataset="nuscenes", scene="0061", sweeps=False)
    drive = ComparedImages.of(scene, "CAM_FRONT", LOOKING)
    assert "images have LiDAR" in find_outlines(drive)[1]
    nothing = np.zeros((drive.size[1], drive.size[0]), dtype=bool)
    monkeypatch.setattr(search_module, "lidar_images", lambda drive: [nothing] * len(drive.compared))
    assert len(drive.compared) > 30 and find_outlines(drive) == ((), "no constant region can be the ego vehicle")
