"""scene.json: exact round trips, messages that name an invalid file and its rule, and the nearest key frame."""

import dataclasses
import doctest
import json

import numpy as np
import pytest
from helpers.classed import classed

from drivesplat.errors import ResultError
from drivesplat.scene.scene import Frame, Scene, Sweep, Track, read_scene, write_scene
from drivesplat.scene.sensors import Camera, Lidar


def pose(seed: int) -> np.ndarray:
    """A pose of numbers without a short decimal representation."""
    return np.random.default_rng(seed).normal(0.0, 1e3, (4, 4))


def some_scene(times: tuple[int, ...] = (1_532_402_927_647_951, 1_532_402_928_147_950)) -> Scene:
    first, last = times[0], times[-1]
    intrinsics = np.array([[1266.417203046554, 0.0, 816.2670197447984], [0.0, 1266.4, 491.507], [0.0, 0.0, 1.0]])
    frame = Frame(
        "CAM_FRONT", first - 35_000, "/data/ä.jpg", 1600, 900, intrinsics, pose(1), pose(2), True, 0, "a", "a.png"
    )
    between = dataclasses.replace(frame, timestamp=first + 10, is_key_frame=False, token="b")
    sweep = Sweep("/data/a.pcd.bin", first, pose(3), True, 0, "c", "LIDAR_TOP", "nuscenes")
    track = Track(
        "instance", *classed("vehicle.car"), np.array([4.1, 1.9, 1.7]), np.array([first, last]), np.array([0, 1]),
        np.stack([pose(4), pose(5)]), np.array([4, 0]),
    )  # fmt: skip
    return Scene(
        "0061", "nuscenes", "v1.0-mini", "Parked truck, ä", np.array([411.3039349319818, 1180.8903791765097, 0.1]),
        np.array(times), (frame, between), (sweep,), (track,), "refined", 2.0, [0, 2], 3,
        (Camera("CAM_FRONT", 1600, 900, intrinsics, np.zeros(5), 0.03, "down"), Camera("CAM_BACK", 8, 9, intrinsics)),
        (Lidar("LIDAR_TOP", np.array([-0.1, 0.1]), 1085), Lidar("LIDAR_SIDE")),
        {"stages": {"extract": {}}, "inputs": {}},
        "of the tests", 25,
    )  # fmt: skip


def assert_same_record(a, b) -> None:
    assert type(a) is type(b)
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes(), field.name
        elif isinstance(x, tuple):
            assert isinstance(y, tuple) and len(x) == len(y), field.name
            for item, other in zip(x, y, strict=True):
                assert_same_record(item, other)
        else:
            assert x == y and type(x) is type(y), field.name


def test_a_scene_round_trips_exactly(tmp_path):
    scene = some_scene()
    write_scene(tmp_path / "scene.json", scene)
    assert_same_record(read_scene(tmp_path / "scene.json"), scene)


def test_the_tiny_drive_round_trips_exactly(tmp_path, tiny_scene):
    write_scene(tmp_path / "scene.json", tiny_scene)
    assert_same_record(read_scene(tmp_path / "scene.json"), tiny_scene)


def test_a_scene_without_frame_range_sweeps_or_tracks_round_trips(tmp_path):
    scene = dataclasses.replace(some_scene(), sweeps=(), tracks=(), key_frame_range=None)
    write_scene(tmp_path / "scene.json", scene)
    assert_same_record(read_scene(tmp_path / "scene.json"), scene)


def test_the_example_of_reading_a_scene_runs(tmp_path, tiny_scene, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene("results/0001/scene.json", tiny_scene)
    (example,) = doctest.DocTestFinder().find(read_scene, "read_scene", globs={"read_scene": read_scene})
    assert doctest.DocTestRunner().run(example) == doctest.TestResults(failed=0, attempted=4)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_a_truncated_scene_is_refused_naming_file_and_rule(tmp_path, share):
    write_scene(tmp_path / "scene.json", some_scene())
    whole = (tmp_path / "scene.json").read_bytes()
    (tmp_path / "scene.json").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ResultError, match=r"scene\.json.*'extract'"):
        read_scene(tmp_path / "scene.json")


def without(key):
    return lambda content: {name: value for name, value in content.items() if name != key}


@pytest.mark.parametrize(
    "edit",
    [
        lambda content: {**content, "schema": 2},
        without("schema"),
        without("frames"),
        without("origin"),
        lambda content: {**content, "another": 1},
        lambda content: {**content, "frames": [1]},
        lambda content: {**content, "frames": [without("token")(content["frames"][0])]},
        lambda content: {**content, "tracks": None},
        lambda content: {**content, "origin": ["x", "y", "z"]},
        lambda content: [content],
        lambda content: "scene",
        lambda content: None,
    ],
)
def test_json_of_another_schema_is_refused_naming_file_and_rule(tmp_path, edit):
    write_scene(tmp_path / "scene.json", some_scene())
    content = edit(json.loads((tmp_path / "scene.json").read_text()))
    (tmp_path / "scene.json").write_text(json.dumps(content))
    with pytest.raises(ResultError, match=r"scene\.json.*'extract'"):
        read_scene(tmp_path / "scene.json")
