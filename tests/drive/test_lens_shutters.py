"""Lenses with a rolling shutter, with shear and with an end; cameras that are placed one by one."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made_drive import K, drive_of
from helpers.hand_made_street import AHEAD, street_model, street_scene

import drivesplat
from drivesplat.drive.cameras import PlacedCamera
from drivesplat.drive.lenses import BANDS
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError
from drivesplat.scene.lens import directions, pixels_of
from drivesplat.scene.rigid import rigid

TIME = 1.0
FORWARDS = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""World axes to the axes of a camera that looks along x."""
WIDE = [40.0, 0.0, -1.0]
"""A polynomial angle_to_radius that images 140 degrees in 64 pixels."""


@pytest.fixture(scope="module")
def drive(tiny_scene, tmp_path_factory) -> TrainedDrive:
    return drive_of(street_scene(tiny_scene), street_model(), tmp_path_factory.mktemp("shutters"))


@pytest.fixture
def world(drive):
    world = drive.state(TIME)
    for name in [*world.actors]:
        if name != AHEAD:
            world.remove(name)
    there = np.eye(4)
    there[:3, 3] = [8.0, 0.0, 30.0]
    world.actors[AHEAD].set_motion(there, np.zeros(6))
    return world


POSE = rigid(FORWARDS.T, np.array([0.0, 0.0, 30.0]))
"""Of a camera 8 m behind the car of `world`."""


def lens(readout: tuple[float, float] = (0.0, 0.0), width: int = 64, **changes) -> "drivesplat.Camera":
    own = {"distortion": np.array(WIDE), "distortion_model": "angle_to_radius", **changes}
    return drivesplat.Camera(width, 48, own.pop("K", K), readout_s=np.array([*readout, 0.0]), **own)


@pytest.mark.parametrize("readout", [(0.0, 0.1), (0.0, -0.1), (0.1, 0.0), (-0.1, 0.0)])
def test_each_band_of_a_lens_shows_its_own_time(world, readout):
    """A camera that passes the car: in the middle of a band the image is that of a camera at the pose of its time."""
    velocity = [12.0, 0.0, 0.0, 0.0, 0.2, 0.0]
    rolling = world.render(lens(readout), camera_to_world=POSE, velocity=velocity).rgb
    axis, length = (1, 64) if readout[0] else (0, 48)
    band = length // BANDS
    for number in (6, 8, 9):
        middle = (number + 0.5) / BANDS - 0.5
        seconds = (readout[0] or readout[1]) * middle
        turned = POSE.copy()
        turned[:3, 3] += POSE[:3, 0] * 12.0 * seconds
        turn = np.array([[1, 0, 0.2 * seconds], [0, 1, 0], [-0.2 * seconds, 0, 1]])
        turned[:3, :3] = POSE[:3, :3] @ np.linalg.qr(turn)[0] * np.sign(np.linalg.qr(turn)[1].diagonal())
        still = world.render(lens(), camera_to_world=turned).rgb
        own = torch.arange(number * band, (number + 1) * band)
        torch.testing.assert_close(rolling.index_select(axis, own), still.index_select(axis, own), atol=0.06, rtol=0)
    whole = world.render(lens(), camera_to_world=POSE).rgb
    assert (rolling - whole).abs().max() > 0.1


def test_a_resting_lens_with_a_rolling_shutter_sees_what_it_sees_without(world):
    rolling = world.render(lens((0.0, 0.1)), camera_to_world=POSE).rgb
    torch.testing.assert_close(rolling, world.render(lens(), camera_to_world=POSE).rgb, atol=0.02, rtol=0)


def test_a_lens_ends_at_its_largest_angle(world):
    ended = lens(max_angle=0.5)
    seen = world.render(ended, camera_to_world=POSE, outputs=["rgb", "valid"])
    angles = np.arccos(directions(ended.lens)[..., 2])
    np.testing.assert_array_equal(seen.valid.numpy(), angles <= 0.5)
    assert not seen.rgb[~seen.valid].any()
    full = world.render(lens(), camera_to_world=POSE).rgb
    torch.testing.assert_close(seen.rgb[seen.valid], full[seen.valid], atol=0.02, rtol=0)


@pytest.mark.parametrize("model", ["angle_to_radius", "radius_to_angle"])
def test_a_camera_matrix_may_shear_the_image_of_a_polynomial(model):
    sheared = np.array([[40.0, 3.0, 30.0], [-2.0, 44.0, 25.0], [0.0, 0.0, 1.0]])
    own = lens(K=sheared, distortion_model=model, distortion=np.array(WIDE if model == "angle_to_radius" else [0.025]))
    rays = directions(own.lens).reshape(-1, 3)
    grid = np.stack(np.meshgrid(np.arange(64), np.arange(48)), axis=-1).reshape(-1, 2)
    known = np.isfinite(rays[:, 0])
    np.testing.assert_allclose(pixels_of(own.lens, rays[known]), grid[known], atol=0.06)
    angle = 0.4
    radius = 40.0 * angle - (angle**3 if model == "angle_to_radius" else 0.0)
    right, down = ([np.sin(angle), 0.0, np.cos(angle)], [0.0, np.sin(angle), np.cos(angle)])
    expected = np.array([[radius, -radius * 2 / 40], [radius * 3 / 40, radius * 44 / 40]]) + sheared[:2, 2] - 0.5
    np.testing.assert_allclose(pixels_of(own.lens, np.array([right, down])), expected, atol=1e-3)


def test_cameras_that_are_placed_one_by_one_see_what_each_sees_alone(drive, world):
    plain, beside = drivesplat.Camera(64, 48, K), POSE.copy()
    beside[:3, 3] += [1.0, 2.0, 0.0]
    placed = [PlacedCamera(plain, POSE, np.zeros(6), TIME), PlacedCamera(lens(), beside, np.zeros(6), TIME)]
    first, second = world.render_placed(placed)
    assert torch.equal(first.rgb, world.render(plain, camera_to_world=POSE).rgb)
    assert torch.equal(second.rgb, world.render(lens(), camera_to_world=beside).rgb)
    with pytest.raises(RequestError, match=r"2 s.*1 s"):
        world.render_placed([dataclasses.replace(placed[0], time=2.0)])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"max_angle": 0.0}, "max_angle"),
        ({"max_angle": float("nan")}, "max_angle"),
        ({"max_angle": 1.0, "distortion_model": "none", "distortion": np.zeros(0)}, "pinhole"),
        ({"K": np.array([[40.0, 50.0, 32.0], [50.0, 40.0, 24.0], [0.0, 0.0, 1.0]])}, "mirrors"),
        ({"K": np.array([[40.0, np.nan, 32.0], [0.0, 40.0, 24.0], [0.0, 0.0, 1.0]])}, "camera matrix"),
        ({"K": np.array([[40.0, 1.0, 32.0], [0.0, 40.0, 24.0], [0.0, 0.0, 1.0]]), "distortion_model": "fisheye",
          "distortion": np.zeros(4)}, "camera matrix"),
    ],
)  # fmt: skip
def test_what_a_lens_cannot_be_is_one_sentence(changes, words):
    with pytest.raises(RequestError, match=words):
        lens(**changes)
