"""Warnings for a drive that stands, is dark, or in which nothing moves."""

import dataclasses
import logging
from collections.abc import Callable

import numpy as np
import pytest
from helpers.drives import World, scene_at, write_world
from PIL import Image

from drivesplat.scene.scene import Scene
from drivesplat.scene.scene_warnings import duration, luminance, max_displacement, scene_warnings, standing_time

DAY = 0.4


def at(scene: Scene, places: Callable[[float], tuple[float, float]], between: bool = True) -> Scene:
    """The scene with the ego vehicle at `places`, a function of seconds."""
    frames = []
    for frame in scene.frames:
        pose = frame.ego_to_world.copy()
        pose[:2, 3] = places(scene.seconds(frame.timestamp))
        frames.append(dataclasses.replace(frame, ego_to_world=pose))
    return dataclasses.replace(scene, frames=tuple(frame for frame in frames if between or frame.is_key_frame))


PATHS = {
    "drives on": (lambda s: (4.0 * s, 0.0), 18.0, 0.0),
    "stands": (lambda s: (7.0, 3.0), 0.0, 4.5),
    "stands, its pose creeping": (lambda s: (0.05 * np.sin(9 * s), 0.02 * s), 0.1, 4.5),
    "creeps": (lambda s: (0.2 * s, 0.0), 0.9, 4.5),
    "drives off late": (lambda s: (0.0, max(0.0, s - 3.0) * 4.0), 6.0, 3.0),
    "there and back": (lambda s: (10.0 - 5.0 * abs(s - 2.0), 0.0), 12.5, 0.0),
}
"""Position by seconds, largest displacement in metres, and standing time in seconds; the tiny drive takes 4.5 s."""


@pytest.mark.parametrize(("path", "metres", "stands"), PATHS.values(), ids=PATHS)
def test_displacement_and_standing_time_of_a_path(tiny_scene, path, metres, stands):
    for between in (True, False):
        scene = at(tiny_scene, path, between)
        assert max_displacement(scene) == pytest.approx(metres, abs=0.11 if metres else 1e-9)
        assert standing_time(scene) == pytest.approx(stands) and duration(scene) == pytest.approx(4.5)
    scene = dataclasses.replace(scene, frames=scene.frames[:1])
    assert (max_displacement(scene), standing_time(scene), duration(scene)) == (0.0, 0.0, 0.0), "a single image"


def still(scene: Scene, *categories: str) -> Scene:
    """The scene with tracks of the given classes only, all static."""
    tracks = (
        dataclasses.replace(track, object_to_world=np.repeat(track.object_to_world[:1], len(track.timestamps), axis=0))
        for track in scene.tracks
        if track.category in categories
    )
    return dataclasses.replace(scene, tracks=tuple(tracks))


STANDS, HALF, DARK, STILL, BARE = (
    "the car hardly moves (0.0 m in 4.5 s): nothing can be triangulated",
    "the car stands for 3.0 of 4.5 s",
    "the images are dark (mean luminance 0.11)",
    "no vehicle moves",
    "nothing is annotated",
)
CASES = {
    "an ordinary drive": (lambda scene: scene, DAY, []),
    "standing": (lambda scene: at(scene, lambda s: (1.0, 2.0)), DAY, [STANDS]),
    "standing for long": (lambda scene: at(scene, PATHS["drives off late"][0]), DAY, [HALF]),
    "standing for a while": (lambda scene: at(scene, lambda s: (max(0.0, s - 1.5) * 4.0, 0.0)), DAY, []),
    "night": (lambda scene: scene, 0.11, [DARK]),
    "dusk": (lambda scene: scene, 0.21, []),
    "parked cars alone": (lambda scene: still(scene, "vehicle.truck"), DAY, [STILL]),
    "a car that stands and someone who walks": (
        lambda scene: dataclasses.replace(
            scene, tracks=tuple(t for t in scene.tracks if t.category != "vehicle.car")
        ), DAY, [STILL],
    ),
    "cones alone": (lambda scene: still(scene, "movable_object.trafficcone"), DAY, [STILL]),
    "the test split": (lambda scene: dataclasses.replace(scene, tracks=()), DAY, [BARE]),
    "everything at once": (lambda scene: still(at(scene, lambda s: (0.0, 0.0)), "vehicle.car"), 0.11,
                           [STANDS, DARK, STILL]),
}  # fmt: skip


@pytest.mark.parametrize(("change", "brightness", "expected"), CASES.values(), ids=CASES)
def test_each_warning_is_one_sentence_and_ordinary_drives_have_none(tiny_scene, change, brightness, expected):
    found = scene_warnings(change(tiny_scene), brightness)
    assert [sentence[: len(start)] for sentence, start in zip(found, expected, strict=True)] == expected
    assert not any("\n" in sentence for sentence in found)


def test_luminance_is_averaged_over_the_whole_drive(tiny_scene, tmp_path):
    """Its second half is dark and has as many sampled images as the first."""
    Image.new("RGB", (96, 54), (0, 0, 0)).save(tmp_path / "dark.png")
    Image.new("RGB", (96, 54), (204, 204, 204)).save(tmp_path / "light.png")
    paths = [str(tmp_path / ("light.png" if i < 9 else "dark.png")) for i in range(18)]
    frames = (dataclasses.replace(f, image_path=p) for f, p in zip(tiny_scene.frames[:18], paths, strict=True))
    assert luminance(dataclasses.replace(tiny_scene, frames=tuple(frames))) == pytest.approx(0.4, abs=0.05)


def test_the_extraction_logs_one_line_per_warning(tmp_path, caplog):
    world = World(key_frames=2, speed=0.0, light=0.2, things=World().things[1:2])
    with caplog.at_level(logging.WARNING, logger="drivesplat.preprocess.extract"):
        scene_at(write_world(tmp_path, world))
    expected = "the car hardly moves", "the images are dark", "no vehicle moves"
    for record, start in zip(caplog.records, expected, strict=True):
        assert record.getMessage().startswith(f"scene 0001: {start}")
