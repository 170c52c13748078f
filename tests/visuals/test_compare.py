"""The film of recorded images beside the renderings of several methods."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.hand_made import recording_of
from helpers.hand_made_street import Reels, checkpoint_of, street_model, street_scene

from drivesplat.errors import DatasetError, ResultError
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.rendering.captions import BEYOND, Caption
from drivesplat.rendering.color_bytes import uint8_image
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.images import read_image
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import CompareJob
from drivesplat.visuals.compare import render_comparison

CPU = DeviceSettings(kind="cpu")


@pytest.fixture(scope="module")
def recording(tiny_scene) -> EvaluationData:
    """Key frame 3 and the last two are held out; images of 41x23 pixels, of which the film shows an even size."""
    keys = tuple(frame for frame in tiny_scene.frames if frame.is_key_frame)
    scene = street_scene(dataclasses.replace(tiny_scene, frames=keys))
    return recording_of(scene, width=41, every_nth=8, offset=3, last_block=2)


@pytest.fixture(scope="module")
def models() -> dict[str, SplatModel]:
    whole = street_model()
    return {"plain": street_model(whole.parts[0]), "street": whole}


def compare(recording: EvaluationData, models: dict[str, SplatModel], path: Path, **changes: Any) -> dict[str, Any]:
    job = CompareJob(**{"eval_camera": "CAM_FRONT", "crf": 18, "captions": False, **changes})
    checkpoints = {name: checkpoint_of(model) for name, model in models.items()}
    return json.loads(json.dumps(render_comparison(checkpoints, recording, job, CPU, path)))


@pytest.fixture(scope="module")
def made(recording, models, tmp_path_factory) -> tuple[dict[str, Any], np.ndarray]:
    """The record and the pictures (n, h, w, 3) of a film without captions."""
    with pytest.MonkeyPatch.context() as patch:
        reels = Reels()
        patch.setattr("drivesplat.rendering.film.write_video", reels)
        record = compare(recording, models, tmp_path_factory.mktemp("made") / "compare.mp4")
    return record, reels["compare"]


def panel(made: tuple[dict[str, Any], np.ndarray], name: str) -> np.ndarray:
    """A panel of every picture, where the record says it is."""
    record, pictures = made
    (place,) = (one for one in record["film"]["panels"] if one["shows"] == name)
    return pictures[:, place["top"] :, place["left"] :][:, :22, :40]


def test_each_recorded_image_is_beside_the_rendering_of_each_method_with_its_psnr(made, recording, models):
    record, pictures = made
    assert pictures.shape == (10, 44, 80, 3)
    for index in range(10):
        image = read_image(recording.frame(index).image_path, (41, 23))[:22, :40]
        np.testing.assert_array_equal(panel(made, "ground truth")[index], image)
        for name, model in models.items():
            view = view_of(recording.record, index, model.parts[0].params["means"].device)
            difference = panel(made, name)[index].astype(int) - uint8_image(model.render(view).image)[:22, :40]
            assert np.abs(difference).max() <= 1
    assert [image["split"] for image in record["images"]] == [
        *["train"] * 3, "interpolation", *["train"] * 4, "extrapolation", "extrapolation"
    ]  # fmt: skip
    np.testing.assert_allclose([image["second"] for image in record["images"]], 0.5 * np.arange(10), atol=1e-6)
    for name in models:
        truth, shown = (panel(made, it) / 255.0 for it in ("ground truth", name))
        expected = -10 * np.log10(((truth - shown) ** 2).mean(axis=(1, 2, 3)))
        np.testing.assert_allclose([image["psnr"][name] for image in record["images"]], expected, atol=0.2)


def test_captions_name_the_methods_with_their_psnr_and_say_what_is_held_out(recording, models, tmp_path, monkeypatch):
    captions: list[Caption] = []

    def encoder(path, frames, count, panels, form):
        captions.extend(caption for _, caption in frames)
        return {"frames": count}

    monkeypatch.setattr("drivesplat.visuals.compare.encode_film", encoder)
    record = compare(recording, models, tmp_path / "compare.mp4")
    assert [caption.notes[0] for caption in captions] == [
        *["training image"] * 3, "held out", *["training image"] * 4, *[f"held out, {BEYOND}"] * 2
    ]  # fmt: skip
    assert captions[3].clock == "1.5 s" and not any(captions[3].notes[1:])
    values = record["images"][3]["psnr"]
    labels = ["ground truth", *(f"{name}, {values[name]:.1f} dB" for name in models), "error of street"]
    assert list(captions[3].labels) == labels


def test_an_unknown_camera_and_a_rendering_without_numbers_are_refused(recording, models, tmp_path):
    with pytest.raises(DatasetError, match=r"eval_camera CAM_BACK is not among the cameras of this run \(CAM_FRONT\)"):
        compare(recording, models, tmp_path / "compare.mp4", eval_camera="CAM_BACK")
    broken = street_model()
    broken.parts[0].params["sh0"].data[:] = np.nan
    with pytest.raises(ResultError, match=r"a rendering of mine contains NaN or Inf; delete its checkpoint\.npz"):
        compare(recording, {"mine": broken}, tmp_path / "compare.mp4")
    assert not list(tmp_path.iterdir())
