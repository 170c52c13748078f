"""The live viewer in a browser: time, a drag, the edits file that comes out; and what it refuses."""

import dataclasses
import socket
import sys
import time

import numpy as np
import pytest
from helpers.chromium import chromium, in_a_browser
from helpers.hand_made_drive import drive_of
from helpers.hand_made_street import AHEAD, checkpoint_of, street_model, street_scene
from helpers.patience import wait_until
from helpers.trainings import PROVENANCE

from drivesplat.drive.live_server import EDGES, LiveServer
from drivesplat.drive.live_view import wxyz_of
from drivesplat.drive.trained_drive import TrainedDrive, open_drive
from drivesplat.errors import RequestError
from drivesplat.io.array_file import write_arrays
from drivesplat.model.checkpoint import write_checkpoint
from drivesplat.scene.scene import write_scene
from drivesplat.workflow.edits_file import read_edits

WIDTH, HEIGHT = 1000, 600


@pytest.fixture(scope="module")
def drive(tiny_scene, tmp_path_factory) -> TrainedDrive:
    return drive_of(street_scene(tiny_scene), street_model(), tmp_path_factory.mktemp("served"))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_without_viser_it_says_what_to_install(drive, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(RequestError, match="pip install"):
        LiveServer([drive])


def test_a_port_in_use_is_named(drive, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", pytest)  # any module: the port is tested first
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(RequestError, match=str(port)):
            LiveServer([drive], port=port)


def test_the_edges_of_a_box_are_those_of_a_cube():
    assert EDGES.shape == (12, 2, 3) and np.allclose(np.linalg.norm(EDGES[:, 0] - EDGES[:, 1], axis=1), 1.0)
    assert np.allclose(np.abs(EDGES), 0.5) and len(np.unique(EDGES.reshape(12, 6), axis=0)) == 12
    assert wxyz_of(np.eye(4)).tolist() == [1.0, 0.0, 0.0, 0.0]


@pytest.mark.viewers
def test_a_later_checkpoint_is_shown_and_changes_stay(drive, tmp_path):
    pytest.importorskip("viser")
    scene, folder = drive.scene, tmp_path / "results/0001/street"
    folder.mkdir(parents=True)
    write_scene(folder.parent / "scene.json", scene)
    write_arrays(folder.parent / "parser.npz", dataclasses.asdict(drive.record))
    checkpoint = dataclasses.replace(checkpoint_of(drive.model), provenance=PROVENANCE)
    write_checkpoint(folder / "checkpoint.npz", checkpoint)
    opened = open_drive(folder, "cpu")
    server = LiveServer([opened], port=free_port(), edits_file=tmp_path / "mine.yaml")
    try:
        session = server.view.session
        session.change(AHEAD, lateral=1.0)
        write_checkpoint(folder / "checkpoint.npz", checkpoint)
        wait_until(lambda: session.drive is not opened)
        assert session.change_of(AHEAD).lateral == 1.0 and session.edited.edit is not None
    finally:
        server.close()


@in_a_browser
def test_what_is_dragged_in_the_browser_is_written_as_the_edit_that_gives_the_picture(drive, tmp_path):
    pytest.importorskip("viser")
    edits = tmp_path / "mine.yaml"
    server = LiveServer([drive], port=free_port(), edits_file=edits)
    controls, view = server.controls, server.view
    try:
        with chromium(tmp_path / "profile") as tab:
            tab.open(server.url, WIDTH, HEIGHT)
            wait_until(lambda: len(server._windows) == 1)
            controls.changing(lambda: (setattr(controls.time, "value", 1.0), controls._set_time()))
            shown = tab.picture()
            wait_until(lambda: np.abs(tab.picture() - shown).max() > 0.1 or tab.picture()[:, :600].std() > 0.05)
            client = next(iter(server._server.get_clients().values()))
            wait_until(lambda: client.camera.image_width == WIDTH)
            controls.changing(lambda: controls.select(AHEAD))
            time.sleep(3.0)  # the handle appears after some frames
            camera = view.followed()
            pose = view.drive.state(1.0).actors[AHEAD].pose
            focal = 0.5 * HEIGHT / np.tan(0.5 * camera.vertical_fov)

            def pixel(place: np.ndarray) -> tuple[int, int]:
                seen = (place - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
                x, y = seen[:2] / seen[2] * focal + [0.5 * WIDTH, 0.5 * HEIGHT]
                return round(x), round(y)

            start, end = (pixel(pose[:3, 3] + pose[:3, 1] * left) for left in (1.6, 3.1))
            tab.mouse("mouseMoved", *start)
            time.sleep(1.0)
            tab.mouse("mousePressed", *start, button="left", clickCount=1)
            for share in np.linspace(0.0, 1.0, 8):
                x, y = (round(a + share * (b - a)) for a, b in zip(start, end, strict=True))
                tab.mouse("mouseMoved", x, y, button="left", buttons=1)
                time.sleep(0.1)
            tab.mouse("mouseReleased", *end, button="left", clickCount=1)
            wait_until(lambda: controls.lateral.value != 0.0)  # the drag has ended
            change = view.session.change_of(AHEAD)
            assert change.lateral == pytest.approx(1.5, abs=0.3) and abs(change.longitudinal) < 0.3
            controls.changing(controls._write)
            picture = view.picture(camera, 320, 192)
            assert not [request for request in tab.requests if request.startswith("http") and server.url not in request]
    finally:
        server.close()
    again = drive.edited(read_edits(edits)["mine"])
    sized = camera.sized(320, 192)
    np.testing.assert_array_equal(again.render(sized, 1.0, camera_to_world=camera.camera_to_world).image, picture)
    assert not np.array_equal(drive.render(sized, 1.0, camera_to_world=camera.camera_to_world).image, picture)
