"""Rolling shutters: each row of an image sees the street from where the camera is at its own time."""

import numpy as np
import pytest
from helpers.demo_worlds import FRONT, RIG, recorder_of

from drivesplat.world.optics.imaging import geometry
from drivesplat.world.optics.raycast import RayCaster
from drivesplat.world.shapes.body import RigidBody
from drivesplat.world.shapes.mesh import Material, box
from drivesplat.world.street.objects import StreetObject
from drivesplat.world.street.paths import GivenPath

READOUT, SECONDS = 0.04, 2.0
WIDTH, HEIGHT = 160, 90


def row_times() -> np.ndarray:
    """The second of each row (h,): the middle one has the timestamp, the last is READOUT after the first."""
    return SECONDS + READOUT * (np.arange(HEIGHT) - HEIGHT // 2) / (HEIGHT - 1)


def test_rows_are_read_downwards_over_the_readout_time_about_the_timestamp():
    camera = recorder_of(width=WIDTH, readout_s=READOUT).camera(FRONT, SECONDS)
    np.testing.assert_allclose(camera.seconds, row_times(), atol=1e-12)
    assert camera.camera_to_street.shape == (HEIGHT, 4, 4)
    np.testing.assert_allclose(camera.pose, recorder_of().camera(FRONT, SECONDS).pose, atol=1e-12)


@pytest.mark.slow
def test_each_row_is_that_of_a_global_shutter_at_its_own_time():
    side = RIG["CAM_BACK_LEFT"]
    rolling, still = (
        recorder_of(width=WIDTH, readout_s=readout, cyclists=1, bend_deg=30.0) for readout in (READOUT, 0.0)
    )
    found = rolling.geometry(side, round(SECONDS * 1e6))
    for row in (0, 45, 89):
        camera = still.camera(side, float(row_times()[row]))
        expected = geometry(still.snapshot(camera.seconds), camera)
        np.testing.assert_allclose(found.depth[row], expected.depth[row], rtol=1e-5)
        np.testing.assert_array_equal(found.objects[row], expected.objects[row])
    middle = geometry(still.snapshot(np.array([SECONDS])), still.camera(side, SECONDS))
    np.testing.assert_allclose(found.depth[45], middle.depth[45], rtol=1e-5)
    assert (found.depth[85] != middle.depth[85]).mean() > 0.9, "no other row is that of the timestamp"


@pytest.mark.parametrize("speed", [30.0, pytest.param(-30.0, marks=pytest.mark.slow)])
def test_a_moving_vertical_edge_is_sheared_by_its_speed_times_the_readout(speed):
    """A board 10 m ahead moves sideways past a standing camera."""
    recorder = recorder_of(width=WIDTH, readout_s=READOUT, ego="stands")
    camera = recorder.camera(FRONT, SECONDS)
    board = box((0.0, -50.0, 10.0), (50.0, 50.0, 10.5), Material.PLAIN, (0.5,) * 3)

    def poses(seconds: np.ndarray) -> np.ndarray:
        sideways = np.tile(np.eye(4), (len(seconds), 1, 1))
        sideways[:, 0, 3] = speed * (seconds - SECONDS)
        return camera.pose @ sideways

    item = StreetObject("board", RigidBody(board), GivenPath(poses))
    shown = geometry(RayCaster([item]).at(camera.seconds), camera).objects == 0
    first = np.argmax(shown, axis=1)
    k = camera.intrinsics
    edge = k[0, 2] + k[0, 0] * speed * (row_times() - SECONDS) / 10.0
    assert shown[:, -1].all() and not shown[:, 0].any()
    assert (np.abs(first - edge) <= 1.0).all()
    shear = k[0, 0] * speed * READOUT / 10.0
    assert first[-1] - first[0] == pytest.approx(shear, abs=1.01) and abs(shear) > 10


def test_where_nothing_moves_the_readout_changes_no_byte():
    still = {"ego": "stands", "vehicles": 0, "pedestrians": 0}
    np.testing.assert_array_equal(*(recorder_of(readout_s=s, **still).image(FRONT, 0) for s in (0.0, READOUT)))
