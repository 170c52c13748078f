"""The hold-out of the measuring protocol, checked image by image."""

import numpy as np
import pytest
from pydantic import ValidationError

from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.scene.splits import frame_groups, held_out_key_frames, sweep_groups
from drivesplat.settings.images import HoldoutSettings

INTERVAL = 500_000


def drive(key_frames: int, cameras=("CAM_FRONT", "CAM_BACK"), between: int = 5, interval: int = INTERVAL) -> Scene:
    """A drive whose cameras have individual delays after the key frame, with `between` images between key frames."""
    frames, sweeps = [], []
    for c, camera in enumerate(cameras):
        for step in range((key_frames - 1) * (between + 1) + 1):
            index, part = divmod(step, between + 1)
            time = index * interval + part * interval // (between + 1) + 7_000 * c
            nearest = index if part <= (between + 1) / 2 else index + 1
            frames.append(
                Frame(camera, time, "", 16, 9, np.eye(3), np.eye(4), np.eye(4), part == 0, nearest, f"{camera} {step}")
            )
    for step in range((key_frames - 1) * 10 + 1):
        index, part = divmod(step, 10)
        sweeps.append(
            Sweep("", step * interval // 10, np.eye(4), part == 0, index, f"sweep {step}", "LIDAR_TOP", "nuscenes")
        )
    times = np.arange(key_frames) * interval
    return Scene("0001", "", "", "", np.zeros(3), times, tuple(frames), tuple(sweeps), (), "nuscenes", 1e6 / interval)


def held_out(count: int, **settings) -> tuple[list[int], list[int]]:
    groups = held_out_key_frames(drive(count), HoldoutSettings(**settings))
    assert groups.keys() == {"interpolation", "extrapolation"}
    return groups["interpolation"], groups["extrapolation"]


@pytest.mark.parametrize(
    ("count", "settings", "interpolation", "extrapolation"),
    [
        (39, {}, [4, 12, 20, 28], [35, 36, 37, 38]),  # the protocol's
        (40, {}, [4, 12, 20, 28], [36, 37, 38, 39]),
        (39, {"every_nth": 0}, [], [35, 36, 37, 38]),
        (39, {"last_block": 0}, [4, 12, 20, 28, 36], []),
        (39, {"every_nth": 0, "last_block": 0}, [], []),
        (10, {"every_nth": 4, "offset": 0, "last_block": 1}, [0, 4, 8], [9]),
        (10, {"every_nth": 1, "offset": 0, "last_block": 3}, [0, 1, 2, 3, 4, 5, 6], [7, 8, 9]),
        (41, {"every_nth": 10, "offset": 10, "last_block": 0}, [10, 20, 30, 40], []),
        (4, {"every_nth": 1, "offset": 1, "last_block": 0}, [1, 2, 3], []),
        (3, {}, [], [0, 1, 2]),
        (1, {"last_block": 0}, [], []),
        (5, {"last_block": 0}, [4], []),
    ],
)
def test_every_nth_and_the_last_block_are_held_out(count, settings, interpolation, extrapolation):
    assert held_out(count, **settings) == (interpolation, extrapolation)


@pytest.mark.parametrize(("every_nth", "offset"), [(8, 9), (1, 2), (4, 40)])
def test_an_offset_beyond_the_first_period_is_refused(every_nth, offset):
    with pytest.raises(ValidationError, match="offset must be at most every_nth"):
        HoldoutSettings(every_nth=every_nth, offset=offset)
    assert HoldoutSettings(every_nth=0, offset=9).offset == 9


HOLDOUT = HoldoutSettings(every_nth=4, offset=2, last_block=2)
"""Of 10 key frames: 2, 6 by interpolation; 8, 9 by extrapolation."""
HELD_OUT = {2: "interpolation", 6: "interpolation", 8: "extrapolation", 9: "extrapolation"}


def test_all_cameras_images_of_a_held_out_timestamp_are_held_out():
    scene = drive(10)
    groups = {
        (frame.camera, frame.sample_index): group
        for frame, group in zip(scene.frames, frame_groups(scene, HOLDOUT), strict=True)
        if frame.is_key_frame
    }
    assert groups == {(c, i): HELD_OUT.get(i, "train") for c in ("CAM_FRONT", "CAM_BACK") for i in range(10)}


def test_a_camera_that_is_left_out_has_a_group_of_its_own_at_training_times():
    """What is held out or excluded anyway stays so, and the other camera's groups do not change."""
    scene = drive(10)
    left_out = HOLDOUT.model_copy(update={"cameras": ("CAM_BACK",)})
    for frame, group, before in zip(
        scene.frames, frame_groups(scene, left_out), frame_groups(scene, HOLDOUT), strict=True
    ):
        aside = frame.camera == "CAM_BACK" and before == "train"
        assert group == ("side_camera" if aside else before)
    assert sweep_groups(scene, left_out) == sweep_groups(scene, HOLDOUT)


@pytest.mark.parametrize("groups", [frame_groups, sweep_groups])
def test_recordings_between_key_frames_are_excluded_within_half_an_interval_of_a_held_out_one(groups):
    scene = drive(10)
    records = scene.frames if groups is frame_groups else scene.sweeps
    for record, group in zip(records, groups(scene, HOLDOUT), strict=True):
        near = any(abs(record.timestamp - i * INTERVAL) < INTERVAL / 2 for i in HELD_OUT)
        held_out = HELD_OUT.get(record.sample_index) if record.is_key_frame else None
        assert group == (held_out or ("excluded" if near else "train")), record.token
    assert {"train", "excluded"} < set(groups(scene, HOLDOUT))
    assert set(groups(scene, HoldoutSettings(every_nth=0, last_block=0))) == {"train"}


DENSE = 100_000
"""Key frames at 10 Hz, as in Waymo and KITTI."""


@pytest.mark.parametrize("seconds", [0.0, 0.16, 0.25, 0.6])
def test_at_10_hz_key_frames_near_a_held_out_one_are_excluded_too(seconds):
    """Neighbours 0.1 s away show the same: without the exclusion, models are measured on what they were trained on."""
    scene = drive(30, between=1, interval=DENSE)
    holdout = HoldoutSettings(every_nth=12, offset=6, last_block=2, neighbourhood_s=seconds)
    held = {6: "interpolation", 18: "interpolation", 28: "extrapolation", 29: "extrapolation"}
    for records, groups in ((scene.frames, frame_groups), (scene.sweeps, sweep_groups)):
        for record, group in zip(records, groups(scene, holdout), strict=True):
            if record.is_key_frame and record.sample_index in held:
                assert group == held[record.sample_index]
            else:
                near = any(abs(record.timestamp - index * DENSE) < seconds * 1e6 for index in held)
                assert group == ("excluded" if near else "train"), record.token


@pytest.mark.parametrize("seconds", [0.0, 0.6])
def test_below_5_hz_the_neighbourhood_is_half_an_interval_whatever_the_setting(seconds):
    scene = drive(10)
    holdout = HOLDOUT.model_copy(update={"neighbourhood_s": seconds})
    assert frame_groups(scene, holdout) == frame_groups(scene, HOLDOUT)
