"""The evaluation data of the stages after training: images, labels and splits by image index."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from helpers.hand_made import recording_of, round_gaussians, write_labels
from PIL import Image

from drivesplat.errors import ResultError
from drivesplat.evaluation.image_metrics import evaluate_groups
from drivesplat.io.storage import write_json
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.evaluation_data import read_evaluation_data
from drivesplat.scene.regions import LABELS, label_image
from drivesplat.scene.scene import write_scene
from drivesplat.scene.training_record import write_training_record

GREY = (0.45, 0.5, 0.4)


def made(by: str) -> dict:
    return {"stages": {by: {}}, "inputs": {}}


@pytest.fixture(scope="module")
def labels() -> np.ndarray:
    """Label images at half the recorded width: a moving car above static pixels above the body of the ego vehicle."""
    labels = np.full((27, 48), LABELS["static"], dtype=np.uint8)
    labels[:, 30:44], labels[20:] = LABELS["moving_car"], LABELS["own_car"]
    return labels


@pytest.fixture(scope="module")
def masks(labels, tiny_scene, tmp_path_factory):
    folder = write_labels(tmp_path_factory.mktemp("masks"), tiny_scene, labels)
    known = {"labels": {}, "images": 0, "regions": "boxes", "sky": "heuristic", "sky_share": 0.0}
    known |= {"own_car": {}, "sky_known": True, "semantic_classes": 0, "visibility": "annotated"}
    write_json(folder / "masks.json", {**known, "provenance": made("masks")})
    return folder


def test_an_image_is_the_recorded_one_at_training_size(tiny_scene):
    with Image.open(tiny_scene.frames[3].image_path) as recorded:
        whole = np.asarray(recorded.convert("RGB")) / 255.0
    recording, smaller = recording_of(tiny_scene), recording_of(tiny_scene, width=48)
    assert (recording.size(3), smaller.size(3)) == ((96, 54), (48, 27))
    np.testing.assert_array_equal(recording.image(3), whole)
    assert np.abs(smaller.image(3) - whole.reshape(27, 2, 48, 2, 3).mean(axis=(1, 3))).mean() < 0.01


def test_labels_come_from_the_masks_or_without_masks_from_the_boxes(tiny_scene, masks, labels):
    given, bare = recording_of(tiny_scene, masks, 48), recording_of(tiny_scene, width=48)
    np.testing.assert_array_equal(given.labels(4), labels)
    np.testing.assert_array_equal(given.ego_mask(4), labels == LABELS["own_car"])
    np.testing.assert_array_equal(bare.labels(4), label_image(tiny_scene, tiny_scene.frames[4], (48, 27)))
    assert not bare.ego_mask(4).any()


def test_every_image_has_its_split(tiny_scene):
    """Key frames are the even images; images between them are excluded next to a held-out one."""
    recording = recording_of(tiny_scene, every_nth=4, offset=2, last_block=2)
    splits = [recording.split(index) for index in range(len(tiny_scene.frames))]
    assert splits[::2] == [*["train", "train", "interpolation", "train"] * 2, *["extrapolation"] * 2]
    assert set(splits[1::2]) <= {"train", "excluded"}


def test_a_prepared_drive_is_read_with_the_provenance_of_its_three_files(tiny_scene, masks, labels, tmp_path):
    record = dataclasses.replace(recording_of(tiny_scene, width=48).record, provenance=made("parser"))
    write_scene(tmp_path / "scene.json", dataclasses.replace(tiny_scene, provenance=made("scene")))
    write_training_record(tmp_path / "parser.npz", record)
    paths = (tmp_path / "scene.json", tmp_path / "parser.npz", masks / "masks.json")
    drive, provenances = read_evaluation_data(*paths)
    assert provenances == [made("scene"), made("parser"), made("masks")]
    assert drive.frame(2).token == tiny_scene.frames[2].token and drive.size(2) == (48, 27)
    np.testing.assert_array_equal(drive.labels(2), labels)
    (tmp_path / "masks.json").write_text("[]")
    with pytest.raises(ResultError, match=r"masks\.json.*masks"):
        read_evaluation_data(*paths[:2], tmp_path / "masks.json")


def test_held_out_groups_are_measured_over_the_regions_of_the_labels(tiny_scene, masks, labels):
    """The PSNR of a constant colour follows from the pixels of the recorded images."""
    recording = recording_of(tiny_scene, masks, 48, every_nth=4, offset=2, last_block=2)
    model = SplatModel([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2)).requires_grad_(False)
    groups = evaluate_groups(model, recording, "CAM_FRONT", None, torch.device("cpu"))
    json.dumps(groups, allow_nan=False)
    assert not any("depth" in group for group in groups.values()), "of no image does LiDAR tell anything"
    for group, key_frames in (("interpolation", (2, 6)), ("extrapolation", (8, 9))):
        images = np.stack([recording.image(2 * key_frame) for key_frame in key_frames])
        for region, mask in (("static", labels == LABELS["static"]), ("all", labels != LABELS["own_car"])):
            error = ((images - GREY) ** 2)[:, mask].mean()
            assert groups[group][region]["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-4)
            assert groups[group][region]["pixels"] == 2 * mask.sum()
