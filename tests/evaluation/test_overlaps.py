"""Other cameras of the rig: overlaps with them, and figures of cameras that training leaves out."""

import numpy as np
import pytest
import torch
from helpers.hand_made import recording_of, round_gaussians
from helpers.rig_drives import rig_drive

from drivesplat.evaluation.image_metrics import evaluate_groups, overlap_masks, seen_by_others, side_camera_metrics
from drivesplat.evaluation.views_aside import place_of_view, views_aside
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Scene

GREY = (0.4, 0.5, 0.6)


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Scene:
    cameras = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK")
    return rig_drive(tmp_path_factory.mktemp("rig"), cameras, 4)


@pytest.fixture(scope="module")
def front(rig) -> EvaluationData:
    return recording_of(rig, every_nth=4, offset=2, last_block=0)


def grey() -> SplatModel:
    return SplatModel([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2)).requires_grad_(False)


def image_of(recording: EvaluationData, camera: str, key_frame: int) -> int:
    (index,) = [i for i, f in enumerate(recording.scene.frames) if (f.camera, f.sample_index) == (camera, key_frame)]
    return index


def test_the_front_camera_shares_both_edges_not_its_middle_and_nothing_with_the_one_behind(front):
    """Computed independently: the far end of each pixel's ray is projected into the other cameras."""
    index = image_of(front, "CAM_FRONT", 2)
    frame, size = front.frame(index), front.size(index)
    seen = seen_by_others(front.record, index)
    random = np.random.default_rng(0)
    columns, rows = random.integers(0, size[0], 500), random.integers(0, size[1], 500)
    rays = np.linalg.inv(continuous_intrinsics(frame, size)) @ np.stack([columns + 0.5, rows + 0.5, np.ones(500)])
    ends = (1e7 * frame.camera_to_world[:3, :3] @ rays).T
    expected = np.zeros(500, dtype=bool)
    for camera in ("CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"):
        other = front.frame(image_of(front, camera, 2))
        pixels, depth = project(ends, inverse(other.camera_to_world), continuous_intrinsics(other, size))
        expected |= (depth > 0) & np.all((pixels >= 0) & (pixels < size), axis=1)
    np.testing.assert_array_equal(seen[rows, columns], expected)
    middle = seen[:, size[0] // 3 : 2 * size[0] // 3]
    assert not middle.any() and seen[size[1] // 2, 2] and seen[size[1] // 2, -3] and 0.1 < seen.mean() < 0.5
    assert not seen_by_others(front.record, image_of(front, "CAM_BACK", 2)).any()


def test_both_parts_are_measured_where_there_are_several_cameras(front, tiny_scene):
    """The PSNR of a constant colour follows from the recorded pixels. A single camera has no overlap."""
    cpu = torch.device("cpu")
    groups = evaluate_groups(grey(), front, "CAM_FRONT", None, cpu)
    index = image_of(front, "CAM_FRONT", 2)
    static = front.labels(index) == 0
    parts = overlap_masks(front.record, index, static)
    np.testing.assert_array_equal(parts["overlap"] ^ parts["no_overlap"], static)
    np.testing.assert_array_equal(parts["overlap"], static & seen_by_others(front.record, index))
    for part, mask in parts.items():
        error = ((front.image(index) - GREY) ** 2)[mask].mean()
        assert groups["interpolation"][part]["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-4)
        assert groups["interpolation"][part]["pixels"] == mask.sum()
    recording = recording_of(tiny_scene, every_nth=4, offset=2, last_block=2)
    alone = evaluate_groups(grey(), recording, "CAM_FRONT", None, cpu)
    assert not {"overlap", "no_overlap"} & set(alone["interpolation"])


def test_a_left_out_camera_is_not_trained_on_but_measured_at_the_times_of_training_images(rig):
    """Key frames 2 and 3 are held out. The PSNR of a constant colour follows from the recorded pixels."""
    left_out = recording_of(rig, every_nth=4, offset=2, last_block=1, cameras=("CAM_FRONT_LEFT",))
    trained = {left_out.frame(i).camera for i in left_out.record.train_images}
    assert trained == {"CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK"}
    at_training_times = [image_of(left_out, "CAM_FRONT_LEFT", key_frame) for key_frame in (0, 1)]
    static = np.concatenate([(left_out.image(i) - GREY)[left_out.labels(i) == 0] for i in at_training_times])
    found = side_camera_metrics(grey(), left_out, None, torch.device("cpu"))
    assert found.keys() == {"CAM_FRONT_LEFT"} and "depth" not in found["CAM_FRONT_LEFT"]
    assert found["CAM_FRONT_LEFT"]["static"]["pixels"] == len(static)
    assert found["CAM_FRONT_LEFT"]["static"]["psnr"] == pytest.approx(-10 * np.log10((static**2).mean()), abs=1e-4)


def test_views_are_listed_nearest_first_and_cameras_last():
    results = [
        {"lateral": {"4.0": {}, "-2.0": {}}, "side_camera": {"CAM_BACK": {}}}, None, {"lateral": {"2.0": {}}}, {},
    ]  # fmt: skip
    found = views_aside(results)
    assert found == [("lateral", "2.0"), ("lateral", "-2.0"), ("lateral", "4.0"), ("side_camera", "CAM_BACK")]
    assert list(map(place_of_view, found)) == ["2 m to the left", "2 m to the right", "4 m to the left", "CAM_BACK"]
