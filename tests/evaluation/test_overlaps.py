"""Overlaps between cameras of the rig: their pixels, and the figures over these."""

import numpy as np
import pytest
import torch
from helpers.hand_made import recording_of, round_gaussians
from helpers.rig_drives import rig_drive

from drivesplat.evaluation.image_metrics import evaluate_groups, overlap_masks, seen_by_others
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse

GREY = (0.4, 0.5, 0.6)
FRONT = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT")


@pytest.fixture(scope="module")
def front(tmp_path_factory) -> EvaluationData:
    return recording_of(
        rig_drive(tmp_path_factory.mktemp("rig"), (*FRONT, "CAM_BACK"), 5), every_nth=4, offset=2, last_block=0
    )


def image_of(recording: EvaluationData, camera: str, key_frame: int) -> int:
    (index,) = [i for i, f in enumerate(recording.scene.frames) if (f.camera, f.sample_index) == (camera, key_frame)]
    return index


@pytest.mark.parametrize("key_frame", [0, 2])
def test_the_front_camera_shares_both_edges_and_not_its_middle(front, key_frame):
    """Computed independently: the far end of each pixel's ray is projected into the other cameras."""
    index = image_of(front, "CAM_FRONT", key_frame)
    frame, size = front.frame(index), front.size(index)
    seen = seen_by_others(front.record, index)
    random = np.random.default_rng(0)
    columns, rows = random.integers(0, size[0], 500), random.integers(0, size[1], 500)
    rays = np.linalg.inv(continuous_intrinsics(frame, size)) @ np.stack([columns + 0.5, rows + 0.5, np.ones(500)])
    ends = (1e7 * frame.camera_to_world[:3, :3] @ rays).T
    expected = np.zeros(500, dtype=bool)
    for camera in ("CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"):
        other = front.frame(image_of(front, camera, key_frame))
        pixels, depth = project(ends, inverse(other.camera_to_world), continuous_intrinsics(other, size))
        expected |= (depth > 0) & np.all((pixels >= 0) & (pixels < size), axis=1)
    np.testing.assert_array_equal(seen[rows, columns], expected)
    middle = seen[:, size[0] // 3 : 2 * size[0] // 3]
    assert not middle.any() and seen[size[1] // 2, 2] and seen[size[1] // 2, -3] and 0.1 < seen.mean() < 0.5


def test_cameras_in_opposite_directions_do_not_overlap(tmp_path):
    recording = recording_of(rig_drive(tmp_path, ("CAM_FRONT", "CAM_BACK"), 2), every_nth=0, offset=0, last_block=0)
    assert not any(seen_by_others(recording.record, index).any() for index in range(4))


def test_static_pixels_are_split_by_overlap(front):
    index = image_of(front, "CAM_FRONT", 2)
    static = np.random.default_rng(1).random(front.labels(index).shape) < 0.5
    parts = overlap_masks(front.record, index, static)
    np.testing.assert_array_equal(parts["overlap"] ^ parts["no_overlap"], static)
    np.testing.assert_array_equal(parts["overlap"], static & seen_by_others(front.record, index))


def test_both_parts_are_measured_where_there_are_several_cameras(front, tiny_scene):
    """The PSNR of a constant colour follows from the recorded pixels. A single camera has no overlap."""
    model = SplatModel([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2)).requires_grad_(False)
    groups = evaluate_groups(model, front, "CAM_FRONT", None, torch.device("cpu"))
    index = image_of(front, "CAM_FRONT", 2)
    static = front.labels(index) == 0
    for part, mask in overlap_masks(front.record, index, static).items():
        error = ((front.image(index) - GREY) ** 2)[mask].mean()
        assert groups["interpolation"][part]["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-4)
        assert groups["interpolation"][part]["pixels"] == mask.sum()
    alone = evaluate_groups(
        model,
        recording_of(tiny_scene, every_nth=4, offset=2, last_block=2),
        "CAM_FRONT",
        None,
        torch.device("cpu"),
    )
    assert not {"overlap", "no_overlap"} & set(alone["interpolation"])
