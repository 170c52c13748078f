"""LiDAR scans of a model: what its Gaussians return, seen along the rays of a sensor."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.hand_made import actors_of, motion_through, round_gaussians, track_of
from helpers.samples import EVERYTHING, sampled
from torch import nn

from drivesplat.errors import ResultError
from drivesplat.kernels import torch_private
from drivesplat.model.gaussians import GaussianSets, concatenate
from drivesplat.model.parameters import OFFSETS
from drivesplat.model.scans import ScanView, group_met, scan_picture, view_of_scan
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN, copied, tensors_of
from drivesplat.rasterization.scans import RayGrid
from drivesplat.scene.scan import Scan, ScanRays
from drivesplat.scene.scan_record import RecordedScan

SPREAD = (1e-3, 1e-3)
PLACE = np.array([2.0, -1.0, 1.5])


def turned(angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = PLACE
    return pose


def recorded(angle: float = 0.4, beams: int = 5, firings: int = 40, seconds: float = 1.0) -> RecordedScan:
    """A sensor that looks all around, turned about the vertical; nothing returned."""
    azimuths = np.linspace(-np.pi, np.pi, firings, endpoint=False, dtype=np.float32)[None].repeat(beams, axis=0)
    elevations = np.linspace(-0.1, 0.1, beams, dtype=np.float32)[:, None].repeat(firings, axis=1)
    empty = np.zeros((beams, firings), dtype=np.float32)
    scan = Scan(ScanRays(azimuths, elevations, empty), empty > 0, empty)
    none = np.full((beams, firings), -1, dtype=np.int16)
    still = np.zeros(3)
    return RecordedScan(
        "TOP", 0, seconds, 0, True, "train", turned(angle), still, still, scan, empty == 0, none, empty > 0
    )


def view(**changes) -> ScanView:
    return view_of_scan(recorded(**changes), SPREAD, torch.device("cpu"))


def walls(logits: tuple[float, float] = (-1.0, 2.0), slope: np.ndarray | None = None) -> SplatModel:
    """A ring of Gaussians 10 m around the sensor, with LiDAR logits that grow along a direction."""
    angles = np.linspace(0.0, 2.0 * np.pi, 300, endpoint=False)
    heights = np.linspace(-2.0, 2.0, 9)
    ring = np.array([[10 * np.cos(a), 10 * np.sin(a), z] for a in angles for z in heights]) + PLACE
    part = round_gaussians(ring, sizes=0.25, opacities=0.95)
    coefficients = torch.zeros(len(ring), 4, 2)
    coefficients[:, 0] = torch.tensor(logits)
    if slope is not None:
        coefficients[:, 1:] = torch.from_numpy(slope).float()
    part.params["lidar_logits"] = nn.Parameter(coefficients)
    return SplatModel([part], None)


def test_a_view_of_a_scan_has_its_pose_rays_and_motion():
    found = view(angle=0.7)
    np.testing.assert_allclose(found.world_to_sensor.numpy() @ turned(0.7), np.eye(4), atol=1e-6)
    assert isinstance(found.rays, RayGrid) and found.rays.azimuths.shape == (5, 40)
    assert found.time == 1.0 and found.beam_spread == SPREAD and not found.linear.any()


def test_a_wall_around_the_sensor_returns_its_range_and_its_intensity():
    picture = walls().scan(view())
    assert (picture.alpha > 0.99).all()
    flat = 10.0 / torch.cos(view().rays.elevations)
    assert (picture.range - flat).abs().median() < 0.15
    expected = torch.sigmoid(torch.tensor(-1.0)).expand(5, 40)
    torch.testing.assert_close(picture.intensity, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(picture.returned, picture.alpha * torch.tensor(2.0).sigmoid(), atol=1e-4, rtol=0)


def test_the_intensity_depends_on_the_direction_in_the_world():
    slope = np.array([[2.0, 0.0], [0.0, 0.0], [0.0, 0.0]])  # the intensity's logit grows along the world's x axis
    picture = walls((0.0, 0.0), slope).scan(view(angle=0.4))
    along_x = torch.cos(view().rays.elevations) * torch.cos(view().rays.azimuths + 0.4)
    torch.testing.assert_close(picture.intensity, torch.sigmoid(2.0 * along_x), atol=0.03, rtol=0)


def test_a_ray_that_meets_nothing_does_not_return():
    model = walls()
    model.parts[0].params["means"].data[:, 0] += 1000.0
    picture = model.scan(view())
    for values in (picture.range, picture.returned, picture.intensity, picture.alpha):
        assert torch.equal(values, torch.zeros(5, 40))


def test_the_lidar_logits_of_an_actor_turn_with_it():
    """Its side that returns more is another side of the world after it has turned by 90 degrees."""
    motion = motion_through([0.0, 2.0], [[10.0, 0.0, 1.0]] * 2, [0.0, np.pi / 2])
    actors = actors_of(track_of(motion), count=4, shaken=False)
    logits = torch.zeros(4, 4, 2)
    logits[:, 0], logits[:, 1, 1] = 0.5, 3.0
    actors.params["lidar_logits"] = nn.Parameter(logits)
    before, after = (sampled(actors, time, SCAN).lidar_logits for time in (0.0, 2.0))
    torch.testing.assert_close(before, logits)
    torch.testing.assert_close(after[:, 0], logits[:, 0])
    torch.testing.assert_close(after[:, 1:, 1], torch.tensor([0.0, 3.0, 0.0]).expand(4, 3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("with_offsets", [False, True])
def test_gaussians_follow_the_states_copied_into_the_tensors(with_offsets):
    """With what they return, how fast they move then and where only the LiDAR sees them, without colours."""
    motion = motion_through([0.0, 2.0, 4.0], [[10.0, 0.0, 1.0], [14.0, 0.0, 1.0], [26.0, 3.0, 1.0]], [0.0, 0.5, 1.0])
    actors = actors_of(track_of(motion), count=4)
    actors.params["lidar_logits"] = nn.Parameter(torch.randn(4, 4, 2, generator=torch.Generator().manual_seed(0)))
    (still,) = walls().parts
    if with_offsets:
        for name, offset in OFFSETS.items():
            shaken = torch.linspace(-0.2, 0.3, still.params[name].numel()).view_as(still.params[name])
            still.params[offset] = nn.Parameter(shaken)
    model = SplatModel([still, actors], None)
    assert torch.equal(model.at(0.5, SCAN).means, model.at(0.5).means) != with_offsets
    early, late = model.states(0.5, SCAN), model.states(3.2, SCAN)
    inputs = copied(early)
    for time, states in ((0.5, early), (3.2, late)):
        torch_private.copy_all(tensors_of(inputs), tensors_of(states))
        found = concatenate(model.sample(inputs, SCAN)).tensors
        expected = model.at(time, EVERYTHING).tensors
        assert found.keys() == expected.keys() >= {"velocities", "lidar_logits"}
        assert not found.pop("sh0").any() and found.pop("shN").numel() == 0
        assert all(torch.equal(values, expected[name]) for name, values in found.items())


def test_alpha_before_a_range_is_that_of_what_is_nearer():
    before = torch.full((5, 40), 12.0)
    before[:, :20] = 5.0
    picture = walls().scan(view(), before=before)
    assert (picture.alpha_before[:, 20:] > 0.99).all() and (picture.alpha_before[:, :20] < 1e-3).all()
    assert walls().scan(view()).alpha_before is None


def test_each_ray_knows_the_group_that_contributes_most():
    """Eleven groups around the sensor, numbered from -1; behind them, unseen, the Gaussians of another."""
    model = walls()
    near = model.at(0.0, EVERYTHING)
    around = torch.atan2(near.means[:, 1] - PLACE[1], near.means[:, 0] - PLACE[0])
    own = ((around + np.pi) * 11 / (2 * np.pi)).long().clamp(max=10) - 1
    far = replace(near, means=near.means + 5.0 * (near.means - torch.from_numpy(PLACE).float()))
    both, groups = concatenate([far, near]), torch.cat([torch.full_like(own, 20), own])
    found, seen = group_met(both, view(angle=0.0), groups), view(angle=0.0).rays.azimuths
    position = (seen + np.pi) * 11 / (2 * np.pi)
    inner = (position % 1.0 - 0.5).abs() < 0.3  # elsewhere two groups share a ray
    assert inner.sum() > 50 and torch.equal(found[inner], position.long()[inner] - 1)
    assert (group_met(near[:0], view(), own[:0]) == -1).all()


def test_a_model_trained_without_lidar_is_refused():
    model = SplatModel([round_gaussians([[5.0, 0.0, 0.0]])], None)
    with pytest.raises(
        ResultError, match=r"trained without LiDAR: .* street_lidar, or train it with train\.scans\.per_image above 0"
    ):
        model.scan(view())
    gaussians = walls().at(0.0)
    assert gaussians.lidar_logits is None, "images need none"
    with pytest.raises(ResultError):
        scan_picture(GaussianSets([gaussians]), view())


def test_rays_that_the_vehicle_blocks_do_not_return():
    """Their ranges stay what the model says, and they have no gradient of a return."""
    open_view, model = view(), walls()
    blocked = torch.zeros_like(open_view.rays.azimuths, dtype=torch.bool)
    blocked[1, 5:9] = True
    free, found = model.scan(open_view), model.scan(dataclasses.replace(open_view, blocked=blocked))
    assert (free.returned[1, 5:9] > 0).all() and not found.returned[blocked].any()
    torch.testing.assert_close(found.returned[~blocked], free.returned[~blocked])
    torch.testing.assert_close(found.range, free.range)
    assert not found.rendered().returned[1, 5:9].any()
