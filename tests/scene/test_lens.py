"""The pixel at which each lens images a direction, and lenses that cannot be."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import REPOSITORY

from drivesplat.scene.lens import central_intrinsics, lens_fault, pixels_of
from drivesplat.scene.sensors import Camera

SIZE = (1280, 966)


def camera_of(model: str, coefficients: list[float], focal: float = 340.0, aspect: float = 1.0) -> Camera:
    k = np.array([[focal, 0.0, 643.5], [0.0, focal * aspect, 479.5], [0.0, 0.0, 1.0]])
    return Camera("front", *SIZE, k, np.array(coefficients), distortion_model=model)


def directions(degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) of unit length up to this angle, and their angles in radians."""
    angles, around = (
        values.ravel() for values in np.meshgrid(np.radians(np.linspace(0.0, degrees, 24)), np.linspace(0.0, 6.2, 17))
    )
    across = np.sin(angles)
    return np.column_stack([across * np.cos(around), across * np.sin(around), np.cos(angles)]), angles


def test_a_polynomial_of_the_angle_reaches_beyond_a_right_angle():
    powers = [339.749, -31.988, 48.275, -7.201]
    rays, angles = directions(95.0)
    radii = sum(c * angles ** (i + 1) for i, c in enumerate(powers))
    seen = pixels_of(camera_of("angle_to_radius", powers, aspect=1.01), 3.0 * rays) - [643.5, 479.5]
    np.testing.assert_allclose(np.hypot(seen[:, 0], seen[:, 1] / 1.01), radii, atol=1e-4)
    beyond = np.sin(angles) > 1e-6
    turned = np.arctan2(seen[beyond, 1] / 1.01, seen[beyond, 0]) - np.arctan2(rays[beyond, 1], rays[beyond, 0])
    np.testing.assert_allclose(np.exp(1j * turned), 1.0, atol=1e-6)


def test_the_two_polynomials_are_inverse_to_each_other():
    rays, _ = directions(80.0)
    # asin: the series of an orthographic lens, whose radius is 340 sin(angle)
    series = [1.0, 0.0, 1 / 6, 0.0, 3 / 40, 0.0, 15 / 336, 0.0, 105 / 3456]
    pixels = pixels_of(camera_of("radius_to_angle", [c / 340.0 ** (i + 1) for i, c in enumerate(series)]), rays[:200])
    orthographic = 340.0 * rays[:200, :2] + [643.5, 479.5]
    near = rays[:200, 2] > 0.9  # where the series has converged
    np.testing.assert_allclose(pixels[near], orthographic[near], atol=1e-2)


def test_the_unified_model_with_a_mirror_at_zero_is_a_pinhole():
    rays, _ = directions(60.0)
    pinhole = pixels_of(camera_of("opencv", [-0.02, 0.001, 0.0003, -0.0002]), rays)
    np.testing.assert_allclose(pixels_of(camera_of("mei", [0.0, -0.02, 0.001, 0.0003, -0.0002]), rays), pinhole)


def test_the_unified_model_images_directions_behind_the_camera():
    """KITTI-360's fisheyes have xi above 2; a direction at a right angle lies at f / xi."""
    camera = camera_of("mei", [2.2, 0.0, 0.0, 0.0, 0.0], focal=1300.0)
    (seen,) = pixels_of(camera, np.array([[1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(seen, [643.5 + 1300.0 / 2.2, 479.5])
    assert central_intrinsics(camera)[0, 0] == pytest.approx(1300.0 / 3.2)
    assert np.isnan(pixels_of(camera, np.array([[0.1, 0.0, -1.0]]))).all(), "there the radius shrinks"


@pytest.mark.parametrize("values", [[0.05, -0.01, 0.002, -0.0004], [0.02625958, 0.03141076, -0.01003215, 0.00107841]])
def test_a_fisheye_is_that_of_opencv(values):
    rays, _ = directions(80.0)
    expected, _ = cv2.fisheye.projectPoints(
        rays[:, None], np.zeros(3), np.zeros(3), camera_of("fisheye", values).intrinsics, np.array(values)
    )
    np.testing.assert_allclose(pixels_of(camera_of("fisheye", values), rays), expected[:, 0], atol=1e-3)


FAULTS = {
    "folds before the edge": (camera_of("angle_to_radius", [340.0, 0.0, -120.0]), "its distortion folds"),
    "folds as radius": (camera_of("radius_to_angle", [1 / 340.0, 0.0, -2e-8]), "its distortion folds"),
    "barrel that folds": (camera_of("opencv", [-3.0, 0.0, 0.0, 0.0]), "its distortion folds"),
    "with its constant": (camera_of("angle_to_radius", [0.0, 340.0, -3.0]), "without a constant"),
    "of normalised radii": (camera_of("angle_to_radius", [1.0, -0.1, 0.14]), "one of 1 at the centre of the image"),
    "the reverse polynomial": (camera_of("radius_to_angle", [340.0, -32.0]), "at the centre of the image"),
    "mirror of the wrong sign": (camera_of("mei", [-0.5, 0.0, 0.0, 0.0, 0.0]), "xi = -0.5"),
}
SOUND = {
    "falls behind the camera": camera_of("angle_to_radius", [340.0, 0.0, -20.0]),
    "woodscape": camera_of("angle_to_radius", [339.749, -31.988, 48.275, -7.201]),
    "kitti 360": camera_of("mei", [2.21, 0.0168, 1.65, 0.0004, 0.0002], focal=1336.0),
    "pincushion": camera_of("opencv", [0.2, 0.01, 0.0, 0.0, 0.0]),
}


def test_a_lens_that_cannot_be_is_refused_and_a_sound_one_is_not():
    for name, (camera, words) in FAULTS.items():
        assert words in str(lens_fault(camera)), name
    for name, camera in SOUND.items():
        assert lens_fault(camera) is None, name


def test_a_recorded_fisheye_agrees_with_its_fit():
    """The calibration of a 190 degree camera of WoodScape, and OpenCV's fisheye that was fitted to it."""
    file = REPOSITORY.parent / "shared/data/odd-inputs/woodscape.json"
    if not Path(file).is_file():
        pytest.skip(f"no recorded calibration at {file}")
    lens = json.loads(file.read_text())["intrinsic"]
    polynomial = camera_of("angle_to_radius", [lens[f"k{i}"] for i in range(1, 5)])
    fit = camera_of("fisheye", [0.02625958, 0.03141076, -0.01003215, 0.00107841], focal=332.4915)
    rays, _ = directions(94.0)
    assert np.abs(pixels_of(polynomial, rays) - pixels_of(fit, rays)).max() < 0.6
