"""The images a second of a live viewer, as a window without a browser counts them."""

import pytest
from helpers.hand_made_drive import drive_of
from helpers.hand_made_street import street_model, street_scene

from benchmarks import live_viewer
from drivesplat.drive import live_server


@pytest.mark.viewers
def test_a_window_counts_images_of_its_size_at_most(tiny_scene, tmp_path, monkeypatch):
    pytest.importorskip("viser")
    monkeypatch.setattr(live_viewer, "WARM_UP_S", 0.5)
    server = live_server.LiveServer(
        [drive_of(street_scene(tiny_scene), street_model(), tmp_path)], port=live_viewer.PORT
    )
    try:
        server.controls.changing(lambda: setattr(server.controls.play, "value", True))
        said = live_viewer.window(server.url.replace("http:", "ws:"), 160, 90, 1.0)
    finally:
        server.close()
    assert " images/s of 160x90; between two images " in said
