"""The film of a method from beside the recorded path, beside the truth."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.drives import World, scene_at, write_world
from helpers.hand_made import recording_of
from helpers.hand_made_street import Reels, checkpoint_of, street_model
from helpers.hand_made_truth import write_truth

from drivesplat.errors import DatasetError
from drivesplat.evaluation.synthetic import DriveTruth
from drivesplat.rendering.captions import Caption
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import TruthFilmJob
from drivesplat.visuals import truth_film
from drivesplat.visuals.truth_film import places_of, render_truth_film

CPU = DeviceSettings(kind="cpu")
SMALL = World(key_frames=2, width=81, height=45)


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> DriveTruth:
    root = write_world(tmp_path_factory.mktemp("tiny"), SMALL)
    scene = scene_at(root, sweeps=False)
    path = write_truth(root, SMALL, scene)
    return DriveTruth.read(path, recording_of(scene, every_nth=2, offset=1))


def film(known: DriveTruth, path: Path, **changes: Any) -> dict[str, Any]:
    job = TruthFilmJob(**{"eval_camera": "CAM_FRONT", "crf": 18, "captions": False, **changes})
    record = render_truth_film(checkpoint_of(street_model()), known, "street", job, CPU, path)
    return json.loads(json.dumps(record, allow_nan=False))


def test_every_key_frame_of_every_view_is_shown_in_order_of_time(known, tmp_path, monkeypatch):
    reels = Reels()
    monkeypatch.setattr("drivesplat.rendering.film.write_video", reels)
    record = film(known, tmp_path / "truth.mp4")
    offsets = [view.left_m for view in known.truth.lateral("CAM_FRONT")]
    assert [item["left_m"] for item in record["images"]] == [left for left in offsets for _ in range(2)]
    assert [item["second"] for item in record["images"]] == [0.0, 0.5] * len(offsets)
    assert (record["fps"], record["frames"]) == (2, 2 * len(offsets))
    pictures = reels["truth"]
    assert pictures.shape == (2 * len(offsets), 44, 3 * 80, 3)
    for number, (_, index, _, frame) in enumerate(places_of(known, "CAM_FRONT")):
        true = known.image(frame.image, known.recording.size(index))
        shown = [pictures[number][:, start : start + 80] / 255.0 for start in (0, 80)]
        np.testing.assert_allclose(shown[0], true[:44, :80], atol=0.5 / 255.0 + 1e-6)
        error = float(np.square(shown[1] - shown[0]).mean())
        assert record["images"][number]["psnr"] == pytest.approx(-10.0 * np.log10(error), abs=0.3)


def test_captions_name_the_place_and_the_psnr(known, tmp_path, monkeypatch):
    captions: list[Caption] = []
    monkeypatch.setattr(truth_film, "encode_film", lambda _, frames, *__: captions.extend(c for _, c in frames) or {})
    record = film(known, tmp_path / "truth.mp4")
    first, psnr = captions[0], record["images"][0]["psnr"]
    assert first.labels == ["ground truth", f"street, {psnr:.1f} dB", "error"] and first.clock == "0.0 s"
    assert first.notes == ["2 m to the left", "", ""]
    with pytest.raises(DatasetError, match="no view of CAM_BACK_LEFT from beside the path"):
        film(known, tmp_path / "truth.mp4", eval_camera="CAM_BACK_LEFT")
