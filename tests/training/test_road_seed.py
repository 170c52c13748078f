"""The seed of a road: its surface through planes and LiDAR points, where it ends, and how finely it is sown."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made import looking_at
from helpers.records import training_record_of
from hypothesis import given
from hypothesis import strategies as st

from drivesplat.model.height_field import HeightField
from drivesplat.model.road import EDGE
from drivesplat.scene.training_record import SeedInfo, TrainingRecord
from drivesplat.settings.train import RoadSettings
from drivesplat.training.road import lidar_road, road_of
from drivesplat.training.road_seed import gaussians_per_side, pixels_of, road_seed, surface_of

LIDAR = RoadSettings(surface="lidar")
KERB, KERB_HEIGHT = 4.0, 0.1
NOISE = 0.015


def points_of(height, noise: float = NOISE, count: int = 60_000) -> np.ndarray:
    """LiDAR points (metres) of the ground 24 m along x and 6 m to each side, `height(x, y)` high."""
    random = np.random.default_rng(0)
    x, y = random.uniform(0.0, 24.0, count), random.uniform(-6.0, 6.0, count)
    return np.column_stack([x, y, height(x, y) + random.normal(0.0, noise, count)])


def surface_through(points: np.ndarray) -> HeightField:
    return surface_of(lidar_road(points, LIDAR), points)[0]


def heights_on(surface: HeightField, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return surface.at(torch.from_numpy(np.column_stack([x, y])).float()).double().numpy()


def hill(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A crest of 150 metres' radius on a road that leans by 3 %."""
    return 3.0 - (x - 12.0) ** 2 / 300.0 + 0.03 * y


def kerb(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return KERB_HEIGHT * (y > KERB) + 0.02 * x


INSIDE = [np.tile(np.linspace(2.0, 22.0, 41), 13), np.repeat(np.linspace(-3.0, 3.0, 13), 41)]


@pytest.mark.parametrize("height", [hill, kerb], ids=["hill", "kerb"])
def test_a_surface_is_within_millimetres_of_the_ground(height):
    """Though each point is off by 15 mm, and one metre beside a kerb."""
    error = heights_on(surface_through(points_of(height)), *INSIDE) - height(*INSIDE)
    assert np.abs(error).max() < 8e-3 and error.std() < 2.5e-3 and abs(error.mean()) < 1e-3


def test_a_kerb_is_no_road_and_what_lies_beside_it_is():
    surface, along = surface_through(points_of(kerb)), np.linspace(2.0, 22.0, 41)
    covered = {aside: surface.covers(torch.from_numpy(np.column_stack([along, 0 * along + aside])).float())
               for aside in (-3.0, 2.8, KERB + 0.1, 5.2)}  # fmt: skip
    shares = {aside: float(found.float().mean()) for aside, found in covered.items()}
    assert shares[-3.0] == shares[2.8] == 1.0 and shares[KERB + 0.1] < 0.1 and shares[5.2] > 0.9


def test_what_stands_on_the_road_does_not_raise_it():
    """A parked car of 1.6 by 4 metres, whose underside the LiDAR does not see."""

    def with_car(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where((np.abs(x - 12.0) < 2.0) & (np.abs(y + 3.0) < 0.8), 0.9, 0.0)

    points = points_of(with_car)
    surface, even = surface_of(lidar_road(points, LIDAR), points)
    x, y = np.tile(np.linspace(6.0, 18.0, 25), 9), np.repeat(np.linspace(-5.0, -1.0, 9), 25)
    of_points = HeightField(surface.lower, EDGE, surface.heights, torch.from_numpy(even))
    known = of_points.covers(torch.from_numpy(np.column_stack([x, y])).float()).numpy()
    away = (np.abs(x - 12.0) > 2.6) | (np.abs(y + 3.0) > 1.4)
    assert known[away].all() and np.abs(heights_on(surface, x, y)[known & away]).max() < 0.01


def test_gaps_between_known_ground_are_covered_and_not_sown():
    """A strip without points, as LiDAR leaves it behind a vehicle; a wide one stays open."""
    points = points_of(lambda x, y: 0.01 * x)
    surface, known = surface_of(lidar_road(points, LIDAR), points)
    narrow = (np.abs(points[:, 1] - 1.0) > 1.9) | (points[:, 0] < 8.0)
    through, even = surface_of(lidar_road(points[narrow], LIDAR), points[narrow])
    gap = np.column_stack([np.linspace(12.0, 20.0, 17), np.full(17, 1.0)])
    assert known.sum() - even.sum() > 20 and surface.covered.sum() - through.covered.sum() < 5
    assert through.covers(torch.from_numpy(gap).float()).all()
    assert (
        not HeightField(through.lower, EDGE, through.heights, torch.from_numpy(even))
        .covers(torch.from_numpy(gap).float())
        .any()
    )
    assert np.abs(heights_on(through, *gap.T) - 0.01 * gap[:, 0]).max() < 0.01
    wide = (np.abs(points[:, 1]) > 4.2) | (points[:, 0] < 8.0)
    opened, _ = surface_of(lidar_road(points[wide], LIDAR), points[wide])
    assert not opened.covers(torch.tensor([[14.0, 0.0], [18.0, 0.0]])).any()


# ---- where it is sown


def driven(images: int = 5, **fields: object) -> TrainingRecord:
    """Images of 320 x 180 pixels by a camera 1.5 m above a flat road, which drives 2 m along x from one to the next."""
    views = [looking_at([10.0 + 2.0 * i, 0.0, 0.5], [2.0 * i, 0.0, 1.5], width=320, height=180) for i in range(images)]
    ego = np.tile(np.eye(4), (images, 1, 1))
    ego[:, 0, 3] = 2.0 * np.arange(images)
    points = points_of(lambda x, y: 0.0 * x).astype(np.float32)
    defaults = {
        "Ks": np.stack([view.K.numpy() for view in views]).astype(float),
        "camtoworlds": np.stack([view.camera_to_world.numpy() for view in views]).astype(float),
        "ego_to_world": ego, "image_sizes": np.tile([320, 180], (images, 1)), "points": points,
        "points_rgb": np.where(points[:, 1:2] > 0, 200, 40).repeat(3, axis=1).astype(np.uint8),
        "seed": SeedInfo(lidar=len(points)),
    }  # fmt: skip
    return dataclasses.replace(training_record_of(images), **{**defaults, **fields})


def test_the_finest_pixel_is_that_of_the_nearest_image_that_shows_a_place():
    record = driven(2)
    places = np.array([[6.0, 0.0, 0.0], [14.0, 1.0, 0.0], [-5.0, 0.0, 0.0], [7.0, 30.0, 0.0]])
    found, shown = pixels_of(record, places)
    assert np.isinf(found[2:]).all() and not shown[2:].any()
    for place, pixel in zip(places[:2], found, strict=False):
        centre = record.camtoworlds[1][:3, 3]  # the second camera is nearer to both
        steps = np.array([[0.01, 0.0, 0.0], [0.0, 0.01, 0.0]])
        rows = [(record.Ks[1] @ (record.camtoworlds[1][:3, :3].T @ (at - centre))) for at in (place, *(place + steps))]
        pixels = np.array([row[:2] / row[2] for row in rows])
        area = abs(np.linalg.det(pixels[1:] - pixels[0])) / 1e-4  # pixels per square metre
        assert pixel == pytest.approx(area**-0.5, rel=0.1)
    one = pixels_of(driven(1), places)[0]
    np.testing.assert_allclose(shown[:2], one[:2] ** -2.0 + found[:2] ** -2.0)


@given(st.lists(st.floats(1e-3, 10.0), min_size=1, max_size=40), st.integers(1, 5000))
def test_cells_get_more_gaussians_the_finer_they_were_seen_up_to_their_number(finest, count):
    per_side = gaussians_per_side(np.array(finest), count)
    assert (per_side >= 1).all() and np.square(per_side).sum() <= max(count, len(finest))
    assert (np.diff(per_side[np.argsort(finest)]) <= 0).all() and EDGE / per_side.max() >= 0.05 - 1e-9


def test_a_seed_covers_what_images_show_and_takes_its_colours_from_the_points_around():
    record = driven()
    seed = road_seed(record, road_of(record, LIDAR), 10_000)
    assert 3000 < len(seed.positions) <= 6000
    assert seed.surface.covers(torch.from_numpy(seed.positions[:, :2]).float()).all()
    assert np.isfinite(pixels_of(record, seed.positions)[0]).mean() > 0.9
    assert np.abs(seed.positions[:, 2]).max() < 0.05 and seed.positions[:, 0].min() > 1.0
    left = np.abs(seed.positions[:, 1] - 2.0) < 1.5
    assert np.abs(seed.colors[left] - 200 / 255).max() < 1e-6
    near = seed.positions[:, 0] < 12.0
    assert seed.spacing[near].mean() < 0.7 * seed.spacing[~near].mean()
    few = road_seed(record, road_of(record, LIDAR), 167)
    assert len(few.positions) == 100 and few.spacing.min() > EDGE
    assert len(np.unique(few.positions[:, :2], axis=0)) == 100


def test_without_lidar_the_surface_is_that_of_the_path():
    none = driven(points=np.zeros((1, 3), np.float32), points_rgb=np.zeros((1, 3), np.uint8), seed=SeedInfo())
    assert road_seed(none, road_of(none, LIDAR), 1000) is None
    path = road_of(none, RoadSettings(surface="lidar_or_path", half_width=3.0))
    seed = road_seed(none, path, 1000)
    assert np.abs(seed.positions[:, 1]).max() < 3.3 and np.abs(seed.positions[:, 2]).max() < 1e-5


def test_there_is_no_road_where_no_ground_is_even_or_images_show_none():
    record = driven()
    road = road_of(record, LIDAR)
    steps = np.floor(2.0 * record.points[:, :2]).sum(axis=1) % 2
    uneven = record.points + np.column_stack([0.0 * steps, 0.0 * steps, 0.1 * steps]).astype(np.float32)
    surface, _ = surface_of(road, uneven)
    inside = torch.from_numpy(np.random.default_rng(0).uniform([3.0, -4.0], [21.0, 4.0], (200, 2))).float()
    assert not surface.covers(inside).any() and torch.isfinite(surface.heights).all()
    away = record.camtoworlds.copy()
    away[:, 2, 3] -= 10.0
    assert road_seed(dataclasses.replace(record, camtoworlds=away), road, 1000) is None


def test_there_is_no_road_without_training_images_or_gaussians():
    record = driven()
    road = road_of(record, LIDAR)
    assert road_seed(dataclasses.replace(record, splits={"train": np.zeros(0, np.int64)}), road, 1000) is None
    assert road_seed(record, road, 0) is None
