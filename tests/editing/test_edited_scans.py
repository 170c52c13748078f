"""What a LiDAR measures of an edited model: returns of vehicles where the edit puts them, and what was behind them."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.hand_made import about_z, actors_of, motion_through, round_gaussians, track_of
from helpers.samples import EVERYTHING, sampled_with
from torch import nn

from drivesplat.editing.placed_model import actor_placements
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.scans import ScanPicture, ScanView
from drivesplat.model.splat_model import SplatModel
from drivesplat.rasterization.scans import RayGrid
from drivesplat.scene.object_class import ObjectClass
from drivesplat.settings.edit import Edit
from drivesplat.trajectories.edited_actors import EditedActor, edited_actors

CAR, SPEED, TIME = "car", 8.0, 1.0
CAR_AT, WALL_AT = 12.0, 30.0
"""Metres ahead of the sensor, at TIME: the rear of the car, and a wall behind it."""
CAR_LOGITS, WALL_LOGITS = (2.0, 5.0), (-2.0, 5.0)
"""Logits of intensity and of a return."""
SIZE = np.array([4.0, 2.0, 1.6])
AHEAD = np.linspace(-0.05, 0.05, 9)
"""Azimuths (radians) that meet the car: it is 2 m wide."""


def plate(x: float, half_width: float, half_height: float, spacing: float = 0.1) -> np.ndarray:
    """Places (n, 3) on an upright plate across the x axis."""
    y, z = np.meshgrid(
        np.arange(-half_width, half_width + 1e-6, spacing), np.arange(-half_height, half_height + 1e-6, spacing)
    )
    return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)


def lidar_logits(count: int, logits: tuple[float, float]) -> nn.Parameter:
    made = torch.zeros(count, 4, 2)
    made[:, 0] = torch.tensor(logits)
    return nn.Parameter(made)


def street() -> SplatModel:
    """A car, the plate of its rear, that drives along x; a wall behind it."""
    places = plate(WALL_AT, 8.0, 2.0, 0.25)
    wall = round_gaussians(places, 0.25, 0.99)
    wall.params["lidar_logits"] = lidar_logits(len(places), WALL_LOGITS)
    rear = plate(-0.5 * SIZE[0], 1.0, 0.8)
    times = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    motion = motion_through(times, [[CAR_AT + 0.5 * SIZE[0] + SPEED * (t - TIME), 0.0, 0.0] for t in times])
    car = actors_of(track_of(motion, CAR, SIZE), count=len(rear), shaken=False)
    with torch.no_grad():
        car.params["means"].copy_(torch.from_numpy(rear))
        car.params["scales"].fill_(float(np.log(0.11)))
        car.params["opacities"].fill_(5.0)
    car.params["lidar_logits"] = lidar_logits(len(rear), CAR_LOGITS)
    return SplatModel([wall, car], None).requires_grad_(False)


def view(left: float = 0.0, azimuths: Any = AHEAD, offset_s: float = 0.0) -> ScanView:
    """The rays of one beam, all at one offset."""
    around = torch.tensor(np.asarray(azimuths), dtype=torch.float32)[None]
    pose = torch.eye(4)
    pose[1, 3] = left
    rays = RayGrid(around, torch.zeros_like(around), torch.full_like(around, offset_s))
    return ScanView(pose, rays, torch.zeros(3), torch.zeros(3), TIME, (1e-3, 1e-3))


def edited(model: SplatModel, *steps: dict[str, Any], time: float = TIME) -> Gaussians:
    """The Gaussians of the model after these steps, as a LiDAR needs them."""
    (group,) = (group for group in model.rigid_groups(0.0).values() if group.motion is not None)
    recorded = [EditedActor.recorded(CAR, ObjectClass.CAR, "vehicle.car", SIZE, group.motion)]
    actors = edited_actors(recorded, Edit.model_validate({"steps": steps}), "here")
    (there,) = actor_placements(actors, np.array([time]))
    return sampled_with(model, time, there, EVERYTHING)


def scan(*steps: dict[str, Any], **changes: Any) -> ScanPicture:
    model = street()
    return model.scan(view(**changes), gaussians=edited(model, *steps) if steps else None)


def assert_meets(picture: ScanPicture, x: float, echo: tuple[float, float], **of_view) -> None:
    """All rays meet a plate at x metres ahead with this echo."""
    assert (picture.alpha > 0.95).all()
    distance = x / np.cos(np.asarray(of_view.get("azimuths", AHEAD)))
    np.testing.assert_allclose(picture.range[0], distance, atol=0.05)
    intensity, returned = torch.sigmoid(torch.tensor(echo))
    np.testing.assert_allclose(picture.intensity[0], float(intensity), atol=0.02)
    np.testing.assert_allclose(picture.returned[0], float(returned), atol=0.05)


def test_the_recorded_car_returns_its_own_echo():
    assert_meets(scan(), CAR_AT, CAR_LOGITS)


def test_rays_of_a_removed_car_return_what_is_behind_it():
    assert_meets(scan({"remove": {"track": CAR}}), WALL_AT, WALL_LOGITS)


def test_a_shifted_car_returns_where_it_now_is_and_no_longer_where_it_was():
    beside = np.arctan2(3.0, CAR_AT) + np.linspace(-0.05, 0.05, 9)
    step = {"shift": {"track": CAR, "lateral": 3.0}}
    assert_meets(scan(step, azimuths=beside), CAR_AT, CAR_LOGITS, azimuths=beside)
    assert_meets(scan(step), WALL_AT, WALL_LOGITS)
    assert_meets(scan({"shift": {"track": CAR, "longitudinal": 5.0}}), CAR_AT + 5.0, CAR_LOGITS)


def test_a_duplicate_has_the_logits_and_the_speed_of_its_original():
    model = street()
    steps = {"duplicate": {"track": CAR, "as": "twin", "longitudinal": -6.0}}
    both = edited(model, steps)
    assert len(both) == len(model) + int(model.of_track(CAR).sum())
    assert_meets(model.scan(view(), gaussians=both), CAR_AT - 6.0, CAR_LOGITS)
    moving = both.velocities[both.velocities.abs().sum(dim=1) > 0]
    assert len(moving) == 2 * int(model.of_track(CAR).sum())
    torch.testing.assert_close(moving, torch.tensor([SPEED, 0.0, 0.0]).expand_as(moving), atol=1e-2, rtol=0)


@pytest.mark.parametrize(
    ("steps", "speed"),
    [
        pytest.param((), SPEED, id="recorded"),
        pytest.param(({"speed": {"track": CAR, "factor": 0.5}},), 0.5 * SPEED, id="slowed"),
        pytest.param(({"stop": {"track": CAR, "at": 0.1, "duration": 0.5}},), 0.0, id="stopped"),
        pytest.param(({"reverse": {"track": CAR}},), -SPEED, id="reversed"),
        pytest.param(({"shift": {"track": CAR, "longitudinal": 2.0}},), SPEED, id="shifted"),
    ],
)
def test_rays_of_a_revolution_meet_the_car_where_the_edited_motion_has_it(steps, speed):
    at_timestamp, earlier = (scan(*steps, offset_s=offset).range[0] for offset in (0.0, -0.1))
    np.testing.assert_allclose(at_timestamp - earlier, 0.1 * speed, atol=0.03)


def test_a_car_that_changes_lanes_moves_sideways_during_a_revolution():
    """From 0.4 s on 4 m to the left in 1.2 s: at TIME, the middle, at 15/8 of the mean speed."""
    model = street()
    found = edited(model, {"shift": {"track": CAR, "lateral": 4.0, "start": 0.4, "duration": 1.2}})
    middle = found.velocities[model.of_track(CAR)].mean(dim=0)
    assert float(middle[1]) == pytest.approx(15 / 8 * 4.0 / 1.2, rel=0.05)
    assert float(middle[0]) == pytest.approx(SPEED, rel=0.1)


def test_the_side_of_a_car_that_returns_more_turns_with_it():
    model = street()
    (car,) = (part for part in model.parts if part.moves)
    with torch.no_grad():
        car.params["lidar_logits"][:, 1:, 0] = torch.tensor([3.0, 0.0, 0.0])
    turned = edited(model, {"shift": {"track": CAR, "yaw": 90.0}}).lidar_logits[model.of_track(CAR)]
    expected = torch.from_numpy(about_z(np.pi / 2) @ np.array([3.0, 0.0, 0.0])).float()
    torch.testing.assert_close(turned[:, 1:, 0], expected.expand(len(turned), 3), atol=1e-4, rtol=0)


def test_a_shifted_sensor_sees_past_the_car():
    assert_meets(scan(left=3.0), WALL_AT, WALL_LOGITS)
    toward = np.arctan2(-3.0, CAR_AT) + np.linspace(-0.03, 0.03, 5)
    assert_meets(scan(left=3.0, azimuths=toward), CAR_AT, CAR_LOGITS, azimuths=toward)
