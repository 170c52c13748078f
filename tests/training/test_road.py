"""Surfaces are flat, and the road is where the car drove: the terms, what they pull on, and what they leave alone."""

import logging

import numpy as np
import pytest
import torch
from helpers.hand_made import actors_of, looking_at, motion_through, round_gaussians, track_of
from helpers.records import training_record_of
from helpers.samples import sampled
from scipy.spatial.transform import Rotation

from drivesplat.kernels.regularizers import mean_thickness
from drivesplat.kernels.road_distance import ROUGHNESS, Road, road_distance
from drivesplat.model.background import Background
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.rigid import rigid
from drivesplat.scene.training_record import SeedInfo, TrainingRecord
from drivesplat.settings.train import RoadSettings, TrainSettings
from drivesplat.training.floaters import LARGEST_STEP
from drivesplat.training.losses import surface_terms
from drivesplat.training.road import CELL, LIDAR_CELL, driven_road, lidar_road, road_of

WIDE = RoadSettings(half_width=1.2, reach=0.3)


def straight(length: float = 20.0, step: float = 2.0, pitch: float = 0.0, roll: float = 0.0, heading: float = 0.0):
    """Ego poses (m, 4, 4) along a straight road from the origin, climbing by `pitch` radians, leaning by `roll`."""
    turn = Rotation.from_euler("ZYX", [heading, -pitch, roll]).as_matrix()
    return np.stack([rigid(turn, at * turn[:, 0]) for at in np.arange(0.0, length + 1e-6, step)])


def on_road(poses: np.ndarray, along: np.ndarray, aside: np.ndarray, above: np.ndarray) -> torch.Tensor:
    """World points (n, 3) by their place in the frame of the first of some poses of a straight road."""
    return torch.from_numpy(np.stack([along, aside, above], axis=1) @ poses[0, :3, :3].T + poses[0, :3, 3]).float()


def road_loss(gaussians: Gaussians, road: Road) -> torch.Tensor:
    return road_distance(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, road)


def gaussians_at(means: torch.Tensor, scales: torch.Tensor, quats: torch.Tensor) -> Gaussians:
    n = len(means)
    return Gaussians.of(means, quats, scales, torch.full((n,), 0.5), torch.zeros(n, 1, 3))


def round_at(means: torch.Tensor, size: float = 1e-4) -> Gaussians:
    return gaussians_at(means, torch.full((len(means), 3), size), torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1))


def distance(road: Road, means: torch.Tensor) -> torch.Tensor:
    """How far points lie over the planes that a road has for them."""
    place, found = road.cells.lookup(means[:, :2])
    assert found.all()
    return (means * road.normals[place]).sum(dim=1) - road.offsets[place]


ROADS = [{}, {"pitch": 0.08}, {"roll": 0.05, "heading": 0.7}, {"pitch": -0.05, "roll": -0.04, "heading": 2.0}]


@pytest.mark.parametrize("lie", ROADS, ids=str)
def test_the_road_is_the_plane_that_the_car_stood_on_and_weighs_less_farther_out(lie):
    """Up to the configured width."""
    random, poses = np.random.default_rng(1), straight(**lie)
    along, aside, above = (random.uniform(*limits, 2000) for limits in ((0, 20), (-2.0, 2.0), (-0.2, 0.2)))
    road, points, width = driven_road(poses, WIDE), on_road(poses, along, aside, above), np.abs(aside)
    place, found = (values.numpy() for values in road.cells.lookup(points[:, :2]))
    assert found[width < 1.2 - CELL].all() and not found[width > 1.2 + CELL].any()
    off = np.abs(road.weights[place].numpy() - (1.0 - (width / 1.2) ** 2))[found]
    assert off.max() < 2.0 * CELL / 1.2 and float(road.weights.min()) >= 0.0
    np.testing.assert_allclose(distance(road, points[found]).numpy(), above[found], atol=1e-4)


def test_along_a_bend_the_road_turns_evenly_from_pose_to_pose():
    """A path that comes down a hill of 100 metres' radius: halfway between two poses height and slope are between
    theirs."""
    angles = np.arange(0.0, 0.2, 0.02)
    turns = Rotation.from_euler("y", angles[:, None]).as_matrix()
    poses = np.stack(
        [rigid(t, 100.0 * np.array([np.sin(a), 0.0, np.cos(a) - 1.0])) for t, a in zip(turns, angles, strict=True)]
    )
    between = 100.0 * np.stack([np.sin(angles[:-1] + 0.01), 0.0 * angles[1:], np.cos(angles[:-1] + 0.01) - 1.0], axis=1)
    road = driven_road(poses, WIDE)
    points = torch.from_numpy(between).float()
    place, _ = road.cells.lookup(points[:, :2])
    assert distance(road, points).abs().max() < 6e-3, "the sagitta of 2 metres is 5 millimetres"
    np.testing.assert_allclose(road.normals[place, 0].numpy(), np.sin(angles[:-1] + 0.01), atol=1e-3)


def test_poses_far_apart_are_not_joined_and_a_lone_one_is_a_road():
    poses = np.concatenate([straight(4.0), straight(2.0) + 0.0])
    poses[3:, 0, 3] += 4.0 + LARGEST_STEP + 1.0
    road = driven_road(poses, WIDE)
    x = torch.tensor([0.5, 3.5, 4.0 + LARGEST_STEP / 2, 21.0])
    _, found = road.cells.lookup(torch.stack([x, torch.zeros(4)], dim=1))
    assert found.tolist() == [True, True, False, True]
    lone = driven_road(poses[:1], WIDE)
    assert lone.cells.lookup(torch.tensor([[0.9, 0.0], [1.3, 0.0]]))[1].tolist() == [True, False]


def test_the_loss_is_the_pseudo_huber_norm_of_how_far_the_mass_lies_off():
    """By its definition: mean square distances of samples drawn from each Gaussian."""
    random, poses = np.random.default_rng(2), straight(pitch=0.05, roll=0.03)
    road = driven_road(poses, WIDE)
    n, samples = 6, 50_000
    means = on_road(
        poses, random.uniform(3, 15, n), np.array([0.0, 0.3, -0.3, 0.7, -1.0, 0.9]), np.linspace(-0.2, 0.25, n)
    )
    scales = torch.from_numpy(random.uniform(0.01, 0.3, (n, 3))).float()
    turns = Rotation.random(n, random_state=3)
    quats = torch.from_numpy(turns.as_quat()[:, [3, 0, 1, 2]] * random.uniform(0.5, 2.0, (n, 1))).float()
    place, _ = road.cells.lookup(means[:, :2])
    normals, offsets = road.normals[place].double().numpy(), road.offsets[place].double().numpy()
    drawn = random.normal(size=(samples, n, 3)) * scales.numpy()
    mass = np.einsum("nij,snj->sni", turns.as_matrix(), drawn) + means.double().numpy()
    square = (((mass * normals).sum(axis=2) - offsets) ** 2).mean(axis=0)
    weights = road.weights[place].numpy()
    expected = (weights * (np.sqrt(square + ROUGHNESS**2) - ROUGHNESS)).sum() / weights.sum()
    assert float(road_loss(gaussians_at(means, scales, quats), road)) == pytest.approx(expected, rel=1e-2)


def test_gaussians_of_the_road_come_to_lie_in_it_flat_and_the_others_stay():
    """Of random ones those within reach and width; kerbs beside and a car's roof above are not pulled on."""
    random, poses = np.random.default_rng(4), straight(pitch=0.06)
    road = driven_road(poses, WIDE)
    n = 60
    aside, above = random.uniform(-1.0, 1.0, n), random.uniform(-0.25, 0.25, n)
    aside[40:50], above[50:] = random.choice([-1, 1], 10) * random.uniform(1.4, 3.0, 10), 0.5
    means = on_road(poses, random.uniform(1, 19, n), aside, above)
    quats = torch.from_numpy(random.normal(size=(n, 4))).float()
    parameters = [means.clone(), torch.log(torch.full((n, 3), 0.1) * torch.tensor([1.0, 0.5, 0.2])), quats]
    parameters = [value.requires_grad_() for value in parameters]
    optimizer = torch.optim.Adam(parameters, lr=1e-2)
    for _ in range(200):
        optimizer.zero_grad()
        road_loss(gaussians_at(parameters[0], parameters[1].exp(), parameters[2]), road).backward()
        optimizer.step()
    with torch.no_grad():
        scales = parameters[1].exp()
        assert distance(road, parameters[0][:40]).abs().max() < 0.01
        axes = Rotation.from_quat(parameters[2][:40].numpy()[:, [1, 2, 3, 0]]).as_matrix()
        shortest = axes[np.arange(40), :, scales[:40].argmin(dim=1).numpy()]
        assert np.median(np.abs(shortest @ road.normals[0].numpy())) > 0.95
    for value, before in zip(parameters, (means, None, quats), strict=True):
        assert before is None or torch.equal(value[40:].detach(), before[40:])


@pytest.mark.parametrize("place", [(50.0, 0.0, 0.0), (5.0, 3.0, 0.0), (5.0, 0.0, 1.0)])
def test_where_there_is_no_gaussian_of_the_road_it_costs_nothing(place):
    road, means = driven_road(straight(), WIDE), torch.tensor([place], requires_grad=True)
    loss = road_loss(round_at(means), road)
    loss.backward()
    assert float(loss.detach()) == 0.0 and not means.grad.any()


def test_the_road_is_that_of_training_images_in_time_order():
    """Three cameras' images one after the other; the key frame that is held out goes round a corner."""
    poses = np.concatenate([straight(12.0)[::3], straight(12.0)[1::3]])
    poses[2, 1, 3] = 8.0
    splits = {"train": np.array([0, 1, 3, 4])}
    record = training_record_of(5, ego_to_world=poses, timestamps=np.array([0, 3, 6, 1, 4]), splits=splits)
    road = road_of(record, WIDE)
    points = torch.tensor([[1.0, 0.0], [4.0, 0.0], [7.5, 0.0], [12.0, 8.0], [10.0, 4.0]])
    assert road.cells.lookup(points)[1].tolist() == [True, True, True, False, False]


def ground_points() -> np.ndarray:
    """Points (n, 3) on ground that rises to the left by 5 %, 40 m x 40 m."""
    places = np.random.default_rng(7).uniform(-20.0, 20.0, (6000, 2))
    return np.column_stack([places, 0.05 * places[:, 1]]).astype(np.float32)


def with_points(points: np.ndarray, seed: SeedInfo) -> TrainingRecord:
    return training_record_of(2, points=points, points_rgb=np.zeros(points.shape, np.uint8), seed=seed)


BY_LIDAR = RoadSettings(surface="lidar", reach=0.3)


def test_by_lidar_the_road_is_the_ground_far_from_the_path_too():
    road = lidar_road(ground_points(), BY_LIDAR)
    random = np.random.default_rng(8)
    places, above = random.uniform(-15.0, 15.0, (500, 2)), random.uniform(-0.2, 0.2, 500)
    means = np.column_stack([places, 0.05 * places[:, 1] + above])
    found = distance(road, torch.from_numpy(means).float())
    np.testing.assert_allclose(found.numpy(), above, atol=0.04)
    assert not road.cells.lookup(torch.tensor([[40.0, 0.0]]))[1].any()


def test_by_lidar_seed_points_of_other_sources_do_not_count():
    """Far points lie anywhere."""
    far = np.random.default_rng(9).uniform(-20.0, 20.0, (3000, 3)).astype(np.float32)
    record = with_points(np.concatenate([ground_points(), far]), SeedInfo(lidar=6000, far=3000))
    road, alone = road_of(record, BY_LIDAR), lidar_road(ground_points(), BY_LIDAR)
    torch.testing.assert_close(road.offsets, alone.offsets, rtol=0.0, atol=0.0)


def test_by_lidar_patches_of_ground_far_apart_have_no_cells_between_them():
    """A loop of a hundred square kilometres needs no more memory than the ground beside its road."""
    here = ground_points()
    there = here + np.float32([10_000.0, -10_000.0, 0.0])
    one, both = lidar_road(here, BY_LIDAR), lidar_road(np.concatenate([here, there]), BY_LIDAR)
    assert np.prod(both.cells.shape) > 1e9
    assert len(both.cells.keys) == 2 * len(one.cells.keys) and (both.cells.keys.diff() > 0).all()
    places = torch.tensor([[3.1, 2.2], [10_003.1, -9_997.8], [5_000.0, -5_000.0]])
    assert both.cells.lookup(places)[1].tolist() == [True, True, False]


def test_without_lidar_points_the_road_by_lidar_has_no_effect_and_this_is_logged(caplog):
    record = with_points(np.ones((50, 3), np.float32), SeedInfo(far=50))
    with caplog.at_level(logging.INFO):
        road = road_of(record, BY_LIDAR)
    assert "train.road_weight has no effect" in caplog.text
    assert float(road_loss(round_at(torch.ones(4, 3)), road)) == 0.0


EITHER = RoadSettings(surface="lidar_or_path", half_width=3.0, reach=0.3)


def driven_from(start: tuple[float, float, float]) -> np.ndarray:
    """Ego poses of a straight road that begins at a place."""
    poses = straight(40.0)
    poses[:, :3, 3] += start
    return poses


def either(poses: np.ndarray, points: np.ndarray, lidar: int) -> Road:
    """The road of a record with these poses and seed points, the first of which are LiDAR returns."""
    seed, colors = SeedInfo(lidar=lidar, far=len(points) - lidar), np.zeros(points.shape, np.uint8)
    record = training_record_of(len(poses), ego_to_world=poses, points=points, points_rgb=colors, seed=seed)
    return road_of(record, EITHER)


@pytest.mark.parametrize("start", [(10.0, 3.0, 1.5), (-60.0, 7.3, 1.5)])
def test_by_lidar_or_path_the_path_counts_where_no_lidar_point_shows_the_ground(start):
    """The ground that LiDAR shows ends after 20 m; the path leads in or out of it, 1.5 m higher."""
    poses = driven_from(start)
    road, alone = either(poses, ground_points(), 6000), lidar_road(ground_points(), EITHER)
    random = np.random.default_rng(11)
    places = np.column_stack([random.uniform(-60.0, 50.0, 3000), random.uniform(0.0, 10.0, 3000)])
    means = torch.from_numpy(np.column_stack([places, np.zeros(3000)])).float()
    cell, known = road.cells.lookup(means[:, :2])
    of_lidar, by_lidar = alone.cells.lookup(means[:, :2])
    by_path = driven_road(poses, EITHER, LIDAR_CELL).cells.lookup(means[:, :2])[1]
    assert torch.equal(known, by_lidar | by_path) and (by_lidar & by_path).any() and (by_path & ~by_lidar).any()
    torch.testing.assert_close(road.offsets[cell[by_lidar]], alone.offsets[of_lidar[by_lidar]], rtol=0.0, atol=0.0)
    assert (road.weights[cell[by_lidar]] == 1.0).all()
    path_alone = by_path & ~by_lidar
    torch.testing.assert_close(road.offsets[cell[path_alone]], torch.full((int(path_alone.sum()),), 1.5))
    beside = (means[path_alone, 1] - start[1]).abs()
    assert (road.weights[cell[path_alone]] < 1.0 - ((beside - LIDAR_CELL).clamp(min=0.0) / 3.0) ** 2 + 1e-6).all()
    assert (road.cells.keys.diff() > 0).all()


def test_by_lidar_or_path_without_lidar_the_road_is_that_under_the_path():
    poses = driven_from((0.0, 0.0, 0.0))
    road = either(poses, np.ones((50, 3), np.float32), 0)
    alone = driven_road(poses, EITHER, LIDAR_CELL)
    torch.testing.assert_close((road.cells.keys, road.offsets), (alone.cells.keys, alone.offsets), rtol=0.0, atol=0.0)
    means = on_road(poses, np.array([5.1, 20.3]), np.array([0.2, -1.4]), np.array([0.1, -0.05]))
    torch.testing.assert_close(distance(road, means), torch.tensor([0.1, -0.05]))


# ---- the terms


def a_street() -> SplatModel:
    """Background over and beside a road, and a car on it."""
    random = np.random.default_rng(5)
    still = Background.from_points(
        random.uniform([2, -3, -0.3], [9, 3, 0.3], (40, 3)),
        random.uniform(size=(40, 3)),
        TrainSettings().gaussians,
        1.0,
    )
    with torch.no_grad():
        still.params["scales"] += torch.from_numpy(random.normal(size=(40, 3))).float()
    moving = actors_of(track_of(motion_through([0.0, 1.0], [[5.0, 0.0, 0.1], [6.0, 0.0, 0.1]])))
    return SplatModel([still, moving], None)


def known() -> Road:
    return driven_road(straight(), WIDE)


def test_terms_are_weighted_and_apply_to_static_parts_only():
    model = a_street()
    sets = model.render(looking_at([5.0, 0.0, 0.0], [-2.0, 0.0, 1.5])).sets
    assert surface_terms(sets, model, None, TrainSettings()) == {}
    assert surface_terms(sets, model, None, TrainSettings(flatness_weight=0.1)).keys() == {"flatness"}
    assert surface_terms(sets, model, known(), TrainSettings(road_weight=0.1)).keys() == {"road"}
    terms = surface_terms(sets, model, known(), TrainSettings(flatness_weight=0.3, road_weight=0.2))
    still = sampled(model.parts[0], 0.0)
    torch.testing.assert_close(terms["flatness"], 0.3 * still.scales.amin(dim=1).mean())
    torch.testing.assert_close(terms["road"], 0.2 * road_loss(still, known()))
    assert float(terms["road"].detach()) > 0.0
    sum(terms.values()).backward()
    moving = [*model.parts[1].params.values(), *model.parts[1].shared.values()]
    assert not any(value.grad is not None and value.grad.any() for value in moving)
    assert model.parts[0].params["scales"].grad.any() and model.parts[0].params["means"].grad.any()


def test_flatness_makes_the_shortest_axis_shorter_and_no_other():
    part = round_gaussians(np.zeros((2, 3)), sizes=0.2)
    with torch.no_grad():
        part.params["scales"] += torch.log(torch.tensor([[1.0, 0.5, 2.0], [3.0, 2.0, 0.25]]))
    flat = mean_thickness(sampled(part, 0.0).scales)
    assert float(flat.detach()) == pytest.approx(0.2 * (0.5 + 0.25) / 2)
    flat.backward()
    assert (part.params["scales"].grad > 0).tolist() == [[False, True, False], [False, False, True]]


def test_a_road_moves_to_the_requested_device():
    moved = known().to(torch.device("meta"))
    assert {t.device.type for t in (moved.normals, moved.cells.keys)} == {"meta"}
