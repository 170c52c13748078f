"""The film of a model's parts: all, static and dynamic ones."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.hand_made_street import Reels, a_format, checkpoint_of, street_actors, street_model, street_scene, views_of

from drivesplat.io.prefetch import THREADS
from drivesplat.model.checkpoint import TrainedCheckpoint
from drivesplat.model.splat_model import SplatModel
from drivesplat.rendering.film import BACKDROP, render_film, render_parts
from drivesplat.rendering.frames import film_frame
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import FilmJob, TrajectorySettings

CPU = DeviceSettings(kind="cpu")


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    return street_scene(tiny_scene)


@pytest.fixture
def reels(monkeypatch) -> Reels:
    made = Reels()
    monkeypatch.setattr("drivesplat.rendering.film.write_video", made)
    return made


def parts_film(scene: Scene, folder: Path, checkpoint: TrainedCheckpoint, **changes: Any) -> dict[str, Any]:
    return render_parts(scene, checkpoint, a_format(**changes), CPU, folder / "parts.mp4")


def test_scene_static_and_dynamic_parts_are_side_by_side(scene, tmp_path, reels):
    """Each third is what a model of these parts alone shows, and a film of them; dynamic parts stand before grey
    instead of the sky."""
    whole = street_model()
    still, actors = street_model(whole.parts[0]), SplatModel([street_actors()], None).requires_grad_(False)
    checkpoint = checkpoint_of(whole)
    record = parts_film(scene, tmp_path, checkpoint)
    views = views_of(record, scene)
    assert (record["shows"], len(reels["parts"])) == (["all", "still", "moving"], len(views))
    thirds = np.split(reels["parts"], 3, axis=2)
    for everything, without, alone, view in zip(*thirds, views, strict=True):
        np.testing.assert_array_equal(everything, film_frame(whole, view))
        np.testing.assert_array_equal(without, film_frame(still, view))
        shown = actors.render(view)
        expected = shown.splats + BACKDROP * (1 - shown.alpha[..., None])
        np.testing.assert_allclose(alone, 255 * expected.clamp(max=1.0), atol=0.51)
    assert 0.3 < (thirds[2] == round(255 * BACKDROP)).all(axis=-1).mean() < 0.9
    for parts, panel in zip(("all", "static", "moving"), thirds, strict=True):
        job = FilmJob(**a_format().model_dump(), trajectory=TrajectorySettings(parts=parts))
        some = render_film(scene, checkpoint, job, CPU, tmp_path / "some.mp4")
        np.testing.assert_array_equal(reels["some"], panel)
        assert some["parts"] == parts and "parts" not in some["offset"]


def test_rendering_does_not_run_far_ahead_of_the_encoder(scene, tmp_path, monkeypatch):
    rendered = []
    monkeypatch.setattr(
        "drivesplat.rendering.film.film_frame", lambda *_: rendered.append(1) or np.zeros((36, 64, 3), np.uint8)
    )

    def encoder(path, frames, size, fps, crf, threads):
        frames = iter(frames)
        next(frames)
        time.sleep(0.05)
        assert 2 <= len(rendered) <= 2 * (1 + THREADS + 1)
        assert len([*frames]) > 2 * THREADS
        path.write_bytes(b"")

    monkeypatch.setattr("drivesplat.rendering.film.write_video", encoder)
    parts_film(scene, tmp_path, checkpoint_of(street_model()))
