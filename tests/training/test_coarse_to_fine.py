"""Trainings that begin with reduced images: what a reduced view shows, and when."""

import dataclasses

import numpy as np
import pytest
import torch

from drivesplat.model.view import View
from drivesplat.rasterization import rasterize
from drivesplat.scene.masks import UNLABELLED
from drivesplat.settings.train import CoarseToFineSettings, TrainSettings
from drivesplat.training.coarse_to_fine import TrainingImages, reduced
from drivesplat.training.schedule import Schedule
from drivesplat.training.views import LidarDepth, TrainingView, view_index

WIDTH, HEIGHT = 14, 9
MIN_HEIGHT = CoarseToFineSettings().min_height


def a_view(width: int = WIDTH, height: int = HEIGHT) -> TrainingView:
    rng = np.random.default_rng(0)
    K = torch.tensor([[0.8 * width, 0.0, 0.45 * width], [0.0, 0.9 * width, 0.55 * height], [0.0, 0.0, 1.0]])
    pixels = torch.from_numpy(rng.integers(0, 256, (height, width, 3), dtype=np.uint8))
    return TrainingView(View(K, torch.eye(4), width, height, 1.5, "CAM_FRONT"), pixels)


def test_colours_are_means_over_blocks_and_what_fills_none_is_left_out():
    view = a_view()
    small = reduced(view, 4)
    blocks = view.pixels[:8, :12].numpy().astype(float).reshape(2, 4, 3, 4, 3).mean(axis=(1, 3))
    assert small.pixels.dtype == torch.uint8 and small.pixels.shape == (2, 3, 3)
    assert np.abs(small.pixels.numpy() - blocks).max() <= 0.5
    assert (small.view.width, small.view.height, small.view.time, small.view.camera) == (3, 2, 1.5, "CAM_FRONT")
    assert all(getattr(small, guide) is None for guide in ("sky", "not_sky", "moving", "ego_mask", "lidar", "classes"))


@pytest.mark.parametrize("factor", [2, 4])
def test_a_reduced_camera_sees_the_blocks_of_the_whole_one(factor):
    """A large Gaussian: the mean over a block of pixels is what the reduced camera's pixel shows."""
    view = a_view(160, 128)
    shape = torch.tensor([[0.3, -0.2, 4.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.6)
    images = []
    for camera in (view.view, reduced(view, factor).view):
        seen = rasterize(*shape, torch.ones(1), torch.ones(1, 3), camera.viewmat[None], camera.K[None], camera.width,
                         camera.height)  # fmt: skip
        images.append(seen.image[0, ..., 0].numpy())
    rows, columns = 128 // factor, 160 // factor
    blocks = images[0].reshape(rows, factor, columns, factor).mean(axis=(1, 3))
    assert images[1].shape == blocks.shape and blocks.max() > 0.2
    assert np.abs(images[1] - blocks).max() < 0.01


def test_blocks_take_masks_by_majority_and_the_ego_mask_by_any_pixel():
    share = {"none": 0, "a corner": 1, "half": 8, "most": 9}
    mask = torch.zeros(4, 4 * len(share), dtype=torch.bool)
    for i, count in enumerate(share.values()):
        block = mask[:, 4 * i : 4 * i + 4]
        block.copy_((torch.arange(16) < count).reshape(4, 4))
    view = dataclasses.replace(a_view(16, 4), sky=mask, not_sky=~mask, moving=mask, ego_mask=mask)
    small = reduced(view, 4)
    assert small.sky.tolist() == small.moving.tolist() == [[False, False, False, True]]
    assert small.ego_mask.tolist() == [[False, True, True, True]]
    assert small.not_sky.tolist() == [[True, False, False, False]], "the whole block"


def test_lidar_keeps_its_depths_at_the_blocks_they_fall_into():
    places = {(0, 0): 1.0, (1, 1): 2.0, (3, 13): 3.0, (7, 5): 4.0, (8, 0): 5.0}
    pixels = torch.tensor([row * WIDTH + column for row, column in places])
    view = dataclasses.replace(a_view(), lidar=LidarDepth(pixels, torch.tensor([*places.values()])))
    small = reduced(view, 2).lidar
    found = {(int(p) // 7, int(p) % 7): [] for p in small.pixels}
    for pixel, depth in zip(small.pixels.tolist(), small.depth.tolist(), strict=True):
        found[pixel // 7, pixel % 7].append(depth)
    assert found == {(0, 0): [1.0, 2.0], (1, 6): [3.0], (3, 2): [4.0]}, "row 8 of 9 fills no block"
    beyond = dataclasses.replace(a_view(), lidar=LidarDepth(pixels[-1:], torch.tensor([5.0])))
    assert reduced(beyond, 2).lidar is None


def test_classes_are_those_of_the_blocks_middles():
    classes = torch.full((HEIGHT, WIDTH), UNLABELLED, dtype=torch.uint8)
    classes[2::4, 2::4] = torch.arange(6, dtype=torch.uint8).reshape(2, 3)
    view = dataclasses.replace(a_view(), classes=classes)
    assert reduced(view, 4).classes.tolist() == [[0, 1, 2], [3, 4, 5]]


NEVER = {"quarter_until": 0.0, "half_until": 0.0}


def images_of(height: int, count: int = 3, **changes: float) -> TrainingImages:
    settings = TrainSettings(iterations=100, coarse_to_fine=CoarseToFineSettings(**{**NEVER, **changes}))
    return TrainingImages([a_view(16, height) for _ in range(count)], Schedule.of(settings, count), seed=7)


@pytest.mark.parametrize(
    ("height", "changes", "expected"),
    [
        (4 * MIN_HEIGHT, {}, [1] * 100),
        (4 * MIN_HEIGHT, {"quarter_until": 0.2, "half_until": 0.5}, [4] * 20 + [2] * 30 + [1] * 50),
        (4 * MIN_HEIGHT, {"half_until": 0.3}, [2] * 30 + [1] * 70),
        (4 * MIN_HEIGHT, {"quarter_until": 0.3}, [4] * 30 + [1] * 70),
        (4 * MIN_HEIGHT - 1, {"quarter_until": 0.2, "half_until": 0.5}, [2] * 50 + [1] * 50),
        (2 * MIN_HEIGHT - 1, {"quarter_until": 0.2, "half_until": 0.5}, [1] * 100),
    ],
)
def test_images_are_reduced_as_long_as_the_settings_say_and_never_to_few_rows(height, changes, expected):
    images = images_of(height, **changes)
    assert [images.factor(step) for step in range(100)] == expected
    assert [images.at(step).pixels.shape[0] for step in (0, 99)] == [height // expected[0], height]
    assert images.at(99) is images.views[view_index(3, 99, 7)] is images.views[images.number(99)]


def test_reduced_images_come_in_the_order_of_whole_ones_and_once_each_is_made(monkeypatch):
    images = images_of(2 * MIN_HEIGHT, half_until=0.5)
    for i, view in enumerate(images.views):
        view.pixels.fill_(10 * i)
    seen = [images.at(step) for step in range(100)]
    assert [int(view.pixels[0, 0, 0]) // 10 for view in seen] == [view_index(3, step, 7) for step in range(100)]
    assert len({id(view) for view in seen[:50]}) == 3, "reduced once, not at every look"
    assert {id(view) for view in seen[50:]} == {id(view) for view in images.views}
