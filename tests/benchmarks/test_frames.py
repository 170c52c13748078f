"""Frames per second and film duration: what the benchmark measures."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.hand_made_street import checkpoint_of, street_model, street_scene

import benchmarks.frames as command
from drivesplat.model.checkpoint import write_checkpoint
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import FilmJob, TrajectorySettings

JOB = FilmJob(
    camera="CAM_FRONT", fps=10, width=32, height=18, horizontal_fov=None, crf=30, trajectory=TrajectorySettings()
)


@pytest.fixture(scope="module")
def scene(tiny_scene):
    return street_scene(tiny_scene)


def test_frame_rate_excludes_the_first_frames_and_film_time_includes_everything(scene, monkeypatch):
    """The test clock advances only by rendering: 1 s per frame, and 0.1 s per frame after the first tenth."""
    now, rendered = {"s": 0.0}, []

    def rendering(model, shot, device):
        for seconds in shot.seconds:
            rendered.append(seconds)
            now["s"] += 1.0 if len(rendered) <= frames // 10 else 0.1
            yield np.zeros((18, 32, 3), np.uint8)

    def film(*_) -> None:
        now["s"] += 7.0

    frames = len(command.film_path(scene, "CAM_FRONT", 10, TrajectorySettings()).timestamps)
    assert frames >= 20
    monkeypatch.setattr(command, "recorded_shot", rendering)
    monkeypatch.setattr(command, "render_film", film)
    monkeypatch.setattr(command, "time", SimpleNamespace(perf_counter=lambda: now["s"]))
    found = command.measure(scene, checkpoint_of(street_model()), JOB, DeviceSettings(kind="cpu"))
    assert len(rendered) == found["frames"] == frames and rendered == sorted(rendered)
    assert found["frames_per_second"] == pytest.approx(10.0) and found["film_seconds"] == pytest.approx(7.0)
    assert found["film_of_seconds"] == pytest.approx(frames / 10)
    assert (found["width"], found["height"], found["gaussians"]) == (32, 18, len(street_model()))


def test_the_command_measures_a_trained_scene(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "read_scene", lambda path: scene)
    write_checkpoint(tmp_path / "checkpoint.npz", checkpoint_of(street_model()))
    threads = torch.get_num_threads()
    words = [str(tmp_path / "checkpoint.npz"), "scene.json", "--width", "32", "--height", "18", "--fps", "4"]
    try:
        assert command.main([*words, "--threads", "1"]) == 0
    finally:
        torch.set_num_threads(threads)
    found = json.loads(capsys.readouterr().out)
    assert found["film_seconds"] > 0.0 and found["frames_per_second"] > 0.0
