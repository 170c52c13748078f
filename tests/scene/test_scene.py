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


def test_scenes_round_trip_exactly(tmp_path, tiny_scene):
    bare = dataclasses.replace(some_scene(), sweeps=(), tracks=(), key_frame_range=None)
    for scene in (some_scene(), bare, tiny_scene):
        write_scene(tmp_path / "scene.json", scene)
        assert_same_record(read_scene(tmp_path / "scene.json"), scene)


def test_the_example_of_reading_a_scene_runs(tmp_path, tiny_scene, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene("results/0001/scene.json", tiny_scene)
    (example,) = doctest.DocTestFinder().find(read_scene, "read_scene", globs={"read_scene": read_scene})
    assert doctest.DocTestRunner().run(example) == doctest.TestResults(failed=0, attempted=4)


def without(key: str, content: dict) -> dict:
    return {name: value for name, value in content.items() if name != key}


def test_a_truncated_file_and_json_of_another_schema_are_refused_naming_file_and_rule(tmp_path):
    path = tmp_path / "scene.json"
    write_scene(path, some_scene())
    whole = path.read_text()
    content = json.loads(whole)
    others = [
        {**content, "schema": 2}, {**content, "another": 1}, {**content, "frames": [1]}, {**content, "tracks": None},
        {**content, "frames": [without("token", content["frames"][0])]}, {**content, "origin": ["x", "y", "z"]},
        *(without(key, content) for key in ("schema", "frames", "origin")), [content], "scene", None,
    ]  # fmt: skip
    for text in (*(whole[: int(share * len(whole))] for share in (0.0, 0.5, 0.99)), *map(json.dumps, others)):
        path.write_text(text)
        with pytest.raises(ResultError, match=r"scene\.json.*'extract'"):
            read_scene(path)
