"""Light and cameras of the demo world, against closed forms."""

import math

import numpy as np
import pytest

from drivesplat.world.optics.imaging import WorldCamera, geometry, render, to_bytes
from drivesplat.world.optics.lighting import daylight, lamplight
from drivesplat.world.optics.raycast import RayCaster, StreetSnapshot
from drivesplat.world.shapes.mesh import Material, SurfaceClass, box
from drivesplat.world.street.objects import StreetObject, fixed

SUN_HEIGHT = math.radians(50)
SUN = np.array([math.cos(SUN_HEIGHT), 0.0, math.sin(SUN_HEIGHT)])
LIGHT = daylight(np.random.default_rng(0))._replace(sun_direction=SUN, clouds=0.0)
DOWN = np.diag([1.0, -1.0, -1.0])
"""An OpenCV camera that looks down: its x along the street's."""


def floor(top: float = 0.0) -> StreetObject:
    """A white plane; the texture of PLAIN fades where a pixel covers metres of it."""
    mesh = box((-50.0, -50.0, top - 1.0), (50.0, 50.0, top), Material.PLAIN, (1.0, 1.0, 1.0))
    return fixed("floor", mesh)


def radiance(objects: list[StreetObject], light=LIGHT, rotation: np.ndarray = DOWN, height: float = 4.0) -> np.ndarray:
    return render(at_rest(objects), light, one_pixel(rotation, height), 1).radiance[0, 0]


def hazy(value: np.ndarray, light=LIGHT) -> np.ndarray:
    """What is left of a radiance over the four metres to the floor."""
    haze = 1.0 - math.exp(-4.0 / 900.0)
    return (1.0 - haze) * value + haze * light.horizon


def test_a_white_plane_sends_back_sun_and_sky_or_the_sky_alone_in_the_shadow_or_a_lamps_light():
    at = 5.0 / math.tan(SUN_HEIGHT)
    roof = fixed("roof", box((at - 2.0, -2.0, 5.0), (at + 2.0, 2.0, 5.2), Material.PLAIN, (1.0, 1.0, 1.0)))
    in_the_sun = hazy(math.sin(SUN_HEIGHT) * LIGHT.sun + LIGHT.sky)
    np.testing.assert_allclose(radiance([floor()]), in_the_sun, rtol=1e-5)
    np.testing.assert_allclose(radiance([floor(), roof]), hazy(LIGHT.sky), rtol=1e-5)
    night = lamplight(np.array([[0.0, 0.0, 6.0]]), np.eye(4))._replace(headlight=0.0)
    squared = 36.0 + 1.0  # lamps are not points: one metre squared is added
    lit = hazy(night.lamp * (6.0 / math.sqrt(squared)) ** 2 / squared + night.sky, night)
    np.testing.assert_allclose(radiance([floor()], night), lit, rtol=1e-5)


@pytest.mark.parametrize("elevation", [0.0, 10.0, 35.0, 90.0])
def test_rays_without_a_hit_show_the_sky(elevation):
    up = math.sin(math.radians(elevation))
    direction = np.array([0.0, math.sqrt(1 - up * up), up])
    side = np.array([1.0, 0.0, 0.0])
    rotation = np.stack([side, np.cross(direction, side), direction], axis=1)
    expected = LIGHT.horizon + (1.0 - math.exp(-4.0 * up)) * (LIGHT.zenith - LIGHT.horizon)
    expected = expected + 0.3 * max(0.0, float(direction @ SUN)) ** 60 * LIGHT.sun
    found = radiance([floor(-100.0)], LIGHT, rotation, 500.0)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


def at_rest(objects: list[StreetObject]) -> StreetSnapshot:
    return RayCaster(objects).at(np.zeros(1))


def camera_of(intrinsics: np.ndarray, pose: np.ndarray, width: int, height: int) -> WorldCamera:
    """A camera with a global shutter at second 0."""
    return WorldCamera(intrinsics, np.zeros(1), pose[None], width, height)


def one_pixel(rotation: np.ndarray, height: float, focal: float = 0.1) -> WorldCamera:
    """A camera of one pixel above the origin that looks straight along its axis."""
    pose = np.eye(4)
    pose[:3, :3], pose[2, 3] = rotation, height
    return camera_of(np.diag([focal, focal, 1.0]), pose, 1, 1)


def test_development_is_a_gamma_of_the_exposed_radiance():
    radiances = np.array([[[0.0, 0.5, 1.0]], [[-0.1, 5.0, 1.0 / 0.62]]])
    expected = [0.0, 255 * 0.31 ** (1 / 2.2), 255 * 0.62 ** (1 / 2.2), 0.0, 255.0, 255.0]
    found = to_bytes(radiances)
    assert found.dtype == np.uint8
    np.testing.assert_allclose(found.ravel(), expected, atol=0.51)


def test_depth_is_along_the_axis_and_infinite_in_the_sky():
    intrinsics = np.array([[10.0, 0, 10], [0, 10.0, 10], [0, 0, 1]])
    camera = camera_of(intrinsics, one_pixel(DOWN, 4.0).pose, 21, 21)
    found = geometry(at_rest([floor()]), camera)
    np.testing.assert_allclose(found.depth, 4.0, rtol=1e-5)
    assert (found.objects == 0).all() and np.isnan(found.radiance).all()
    upward = camera_of(camera.intrinsics, one_pixel(np.eye(3), 4.0).pose, 21, 21)
    found = geometry(at_rest([floor()]), upward)
    assert np.isinf(found.depth).all() and (found.objects == -1).all()
    assert (found.classes == SurfaceClass.SKY).all()
