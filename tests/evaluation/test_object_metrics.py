"""The figures of single objects: together they are those of their regions."""

import json
from collections import defaultdict

import numpy as np
import pytest
import torch
from helpers.hand_made import recording_of, round_gaussians

from drivesplat.evaluation.image_metrics import measure_groups
from drivesplat.evaluation.object_metrics import by_object, object_errors
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.regions import LABELS

GREY = (0.4, 0.5, 0.6)


def test_the_objects_of_a_region_add_up_to_it(tiny_scene):
    recording = recording_of(tiny_scene, width=96, every_nth=4, offset=2, last_block=2)
    model = SplatModel([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2)).requires_grad_(False)
    measured = measure_groups(model, recording, "CAM_FRONT", None, torch.device("cpu"), {})
    json.dumps([(own.objects, own.frames) for own in measured.values()], allow_nan=False)
    compared = 0
    for figures, records, _ in measured.values():
        assert [record["pixels"] for record in records] == sorted((r["pixels"] for r in records), reverse=True)
        region = figures["vehicle"]
        if region is None:
            continue
        vehicles = [r for r in records if r["class"] not in ("pedestrian", "animal") and r["psnr"] is not None]
        pixels = sum(record["pixels"] for record in vehicles)
        pooled = sum(record["pixels"] * 10 ** (-record["psnr"] / 10) for record in vehicles) / pixels
        assert pixels == region["pixels"] and -10 * np.log10(pooled) == pytest.approx(region["psnr"], abs=1e-6)
        compared += 1
    assert compared, "some vehicle is in sight"


def test_each_object_has_its_own_error_over_the_images_that_show_it(tiny_scene):
    """An image that is wrong by 0.1 at one object alone; the body of the ego vehicle counts for none."""
    recording = recording_of(tiny_scene, width=96, every_nth=4, offset=2, last_block=2)
    found, wrong = defaultdict(list), {}
    for index in (4, 12):
        truth, labels = recording.image(index), recording.labels(index)
        for one in object_errors(recording, index, truth, truth, labels):
            assert one.squared_error == 0.0
            found[one.box.track_id].append(one)
        moving = np.isin(labels, [LABELS["moving_car"], LABELS["moving_other_vehicle"]])
        image = np.where(moving[..., None], np.clip(truth - 0.1, 0, None), truth)
        wrong[index] = object_errors(recording, index, image, truth, labels)
        own_car = np.full_like(labels, LABELS["own_car"])
        assert object_errors(recording, index, image, truth, own_car) == []
    for record in by_object([one for ones in wrong.values() for one in ones]):
        own = found[record["id"]]
        assert record["images"] == len(own) and record["pixels"] == sum(one.pixels for one in own)
        assert record["mean_speed"] == pytest.approx(np.mean([one.box.speed for one in own]))
        assert record["moves"] == any(one.box.moves for one in own)
        if record["psnr"] is not None and record["moves"]:
            assert record["psnr"] == pytest.approx(20.0, abs=1.5)
    assert by_object([]) == []
