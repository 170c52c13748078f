"""The checks that all readers share, on plain values."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import (
    MAX_MOUNT,
    checked_beams,
    checked_intrinsics,
    checked_pose,
    checked_readout,
    checked_text,
    checked_transform,
    order_faults,
    require_increasing,
)
from drivesplat.readers.drive_checks import require_microseconds, returns_fault
from drivesplat.readers.record_names import named, shown
from drivesplat.scene.sensors import LidarReturns

TURN = Rotation.from_euler("xyz", [0.3, -0.2, 1.1]).as_matrix()


def transform(rotation: np.ndarray, translation=(1.0, 2.0, 3.0)) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix.tolist()


def test_rounding_of_a_rotation_is_accepted_and_removed():
    found = checked_transform(transform(TURN.round(3)), "camera front")
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found, transform(TURN), atol=2e-3)


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (transform(TURN @ np.diag([1.0, -1.0, 1.0])), "mirrors"),
        (transform(-TURN), "mirrors"),
        (transform(1.01 * TURN), "not rigid"),
        (transform(0.001 * TURN), "not rigid"),
        (transform(np.zeros((3, 3))), "not rigid"),
        (transform(1e200 * TURN), "not rigid"),
        (transform(TURN @ np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])), "not rigid"),
        (transform(TURN @ np.diag([1.0, 0.5, 2.0])), "not rigid"),
        (np.array(transform(TURN)).T.tolist(), "last row .* seems to be transposed"),
        (transform(TURN)[:3], "4x4"),
        (transform(TURN, (np.nan, 0.0, 0.0)), "4x4"),
        (transform(TURN, (2e8, 0.0, 0.0)), "translation .* at most 1e.08"),
        ([[str(value) for value in row] for row in transform(TURN)], "4x4"),
        (None, "4x4"),
        ({}, "4x4"),
        ([None] * 4, "4x4"),
        ([[True] * 4] * 4, "4x4"),
    ],
)
def test_a_transform_that_is_not_rigid_is_refused_with_what_is_wrong(matrix, said):
    with pytest.raises(DatasetError, match=f"^camera front: .*{said}"):
        checked_transform(matrix, "camera front")


def test_the_bound_of_a_mount_is_nearer_than_that_of_a_drive():
    assert checked_pose([1700.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], "ego")[0, 3] == 1700.0
    with pytest.raises(DatasetError, match="at most 100"):
        checked_pose([1700.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], "camera front", MAX_MOUNT)


def test_a_pose_has_its_quaternions_order():
    x, y, z, w = Rotation.from_matrix(TURN).as_quat()
    np.testing.assert_allclose(checked_pose([1.0, 2.0, 3.0], [w, x, y, z], "ego"), transform(TURN), atol=1e-12)


def test_intrinsics_are_compared_with_an_image_only_if_one_is_given():
    k = [[1e-3, 0.0, -5.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_array_equal(checked_intrinsics(k, "camera front"), k)
    with pytest.raises(DatasetError, match="camera front: its focal length"):
        checked_intrinsics(k, "camera front", (640, 480))


@pytest.mark.parametrize("value", ["car 7", "ä𝄞", "a" * 1000, "no\u00a0break"])
def test_other_text_is_accepted(value):
    assert checked_text(value, "track 7", "id") == value


def test_readout_and_beams_may_be_unknown():
    assert checked_readout(None, None, "camera front") == (None, None)
    assert checked_readout(0, "left", "camera front") == (0.0, "left")
    assert checked_beams(None, None, "lidar top") == (None, None)
    elevations, steps = checked_beams([-0.5, 0.1], 1800.0, "lidar top")
    assert elevations.tolist() == [-0.5, 0.1] and steps == 1800


def test_long_values_and_tokens_are_shortened_in_messages():
    assert len(shown(["a" * 5000] * 5000)) < 500 and len(shown({f"{i}": [0] * 99 for i in range(99)})) < 500
    assert len(named("sample", "a" * 5000)) < 100 and named("sample", "abc") == "sample abc"
    assert "\n" not in named("sample", "a\nb") and named("sample", None) == "sample None"


def test_every_timestamp_out_of_order_is_listed_and_the_first_is_raised():
    times, tokens = [0, 2, 1, 5, 5], list("abcde")
    end = ": its timestamp is not later than that of the one before it"
    assert list(order_faults(times, "poses[{}]".format)) == [f"poses[2]{end}", f"poses[4]{end}"]
    assert list(order_faults([], str)) == list(order_faults([4, 5], str)) == []
    with pytest.raises(DatasetError, match=f"^sample c{end}"):
        require_increasing(times, tokens, "sample")
    np.testing.assert_array_equal(require_increasing([4, 5], ["a", "b"], "sample"), [4, 5])


@pytest.mark.parametrize(
    ("times", "refused"),
    [
        ([0, 1000], False),
        ([0, 999], True),
        ([0, 1, 1, 2], True),
        ([0, 500_000, 500_001, 1_000_000], False),
        ([5], False),
        ([0, 3_600_000_000], False),
        ([0, 3_600_000_001], True),
        ([1_532_402_927_000_000_000, 1_532_402_947_000_000_000], True),
    ],
)
def test_key_frames_nearer_than_a_millisecond_or_over_an_hour_are_refused(times, refused):
    if refused:
        with pytest.raises(DatasetError, match=r"^scene 1: .*must be microseconds"):
            require_microseconds(times, "scene 1")
    else:
        require_microseconds(times, "scene 1")


@pytest.mark.parametrize(
    ("points", "others", "said"),
    [
        ([[1.0, 2.0, 3.0], [0.0, -999.0, 0.0]], {}, None),
        ([[1.0, 2.0, 3.0], [0.0, -1001.0, 0.0]], {}, "a return is 1e.03 m away"),
        ([[1e11, 0.0, 0.0]], {}, "1e.11 m away"),
        (np.empty((0, 3)), {}, "no return with finite coordinates"),
        ([[1.0, 2.0, 3.0]], {"intensity": np.array([np.nan])}, "intensity"),
        ([[1.0, 2.0, 3.0]], {"offsets_s": np.array([np.inf])}, "time"),
        ([[1.0, 2.0, 3.0]], {"rings": np.array([-1])}, None),
    ],
)
def test_returns_that_no_lidar_measures_are_a_fault_of_their_file(points, others, said):
    fault = returns_fault(LidarReturns(np.array(points), **others))
    assert fault is None if said is None else re.search(rf"^is corrupt \(.*{said}", fault)
