"""Cameras that training leaves out: what is measured on them."""

import numpy as np
import pytest
import torch
from helpers.hand_made import recording_of, round_gaussians
from helpers.rig_drives import rig_drive

from drivesplat.evaluation.image_metrics import side_camera_metrics
from drivesplat.evaluation.views_aside import place_of_view, views_aside
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.evaluation_data import EvaluationData

GREY = (0.4, 0.5, 0.6)
CPU = torch.device("cpu")
CAMERAS = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_BACK")
HOLDOUT = {"every_nth": 4, "offset": 2, "last_block": 1}


def grey() -> SplatModel:
    return SplatModel([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2)).requires_grad_(False)


@pytest.fixture
def left_out(tmp_path) -> EvaluationData:
    return recording_of(rig_drive(tmp_path, CAMERAS, 6), **HOLDOUT, cameras=("CAM_FRONT_LEFT",))


def test_a_left_out_camera_is_measured_at_the_times_of_training_images(left_out):
    """Key frames 2 and 5 are held out. The PSNR of a constant colour follows from the recorded pixels."""
    frames = enumerate(left_out.scene.frames)
    own = [i for i, frame in frames if frame.camera == "CAM_FRONT_LEFT" and frame.is_key_frame]
    at_training_times = [i for i in own if left_out.frame(i).sample_index in (0, 1, 3, 4)]
    static = np.concatenate([(left_out.image(i) - GREY)[left_out.labels(i) == 0] for i in at_training_times])
    found = side_camera_metrics(grey(), left_out, None, CPU)
    assert found.keys() == {"CAM_FRONT_LEFT"}
    assert found["CAM_FRONT_LEFT"]["static"]["pixels"] == len(static)
    assert found["CAM_FRONT_LEFT"]["static"]["psnr"] == pytest.approx(-10 * np.log10((static**2).mean()), abs=1e-4)
    assert "depth" not in found["CAM_FRONT_LEFT"]


def test_no_image_of_a_left_out_camera_is_trained_on(left_out):
    cameras = {left_out.frame(i).camera for i in left_out.record.train_images}
    assert cameras == {"CAM_FRONT", "CAM_BACK"}


def test_views_are_listed_nearest_first_and_cameras_last():
    results = [
        {"lateral": {"4.0": {}, "-2.0": {}}, "side_camera": {"CAM_BACK": {}}}, None, {"lateral": {"2.0": {}}}, {},
    ]  # fmt: skip
    found = views_aside(results)
    assert found == [("lateral", "2.0"), ("lateral", "-2.0"), ("lateral", "4.0"), ("side_camera", "CAM_BACK")]
    assert list(map(place_of_view, found)) == ["2 m to the left", "2 m to the right", "4 m to the left", "CAM_BACK"]
