"""Distorted images become those of a pinhole camera, without an empty pixel."""

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.polynomial import Polynomial
from PIL import Image

from drivesplat.errors import DatasetError
from drivesplat.preprocess.undistort import _maps, distortion_fault, undistorted, view_kept
from drivesplat.scene.images import read_image
from drivesplat.scene.scene import Scene
from drivesplat.scene.sensors import Camera

pytestmark = pytest.mark.usefixtures("uncompared")

SIZE = (320, 180)
K = np.array([[210.0, 0.0, 158.0], [0.0, 205.0, 91.0], [0.0, 0.0, 1.0]])
LENSES = {
    "barrel": ("opencv", [-0.25, 0.06, 0.001, -0.0005]),
    "pincushion": ("opencv", [0.2, 0.01, 0.0, 0.0, 0.0]),
    "rational": ("opencv", [0.3, 0.05, 0.0005, 0.0, 0.001, 0.6, 0.1, 0.002]),
    "thin prism": ("opencv", [-0.2, 0.04, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.004, -0.001, -0.003, 0.001]),
    "fisheye": ("fisheye", [0.05, -0.01, 0.002, -0.0004]),
    "polynomial of the angle": ("angle_to_radius", [210.0, -4.0, 12.0, -9.0, 1.5]),
    "polynomial of the radius": ("radius_to_angle", [1.0 / 210.0, 3e-7, -2e-9]),
    "unified": ("mei", [0.9, -0.1, 0.02, 0.0004, -0.0003]),
}


def seen(rays: np.ndarray) -> np.ndarray:
    """The colours (..., 3) uint8 of directions x/z, y/z (..., 2): waves that a few pixels resolve."""
    x, y = rays[..., 0], rays[..., 1]
    waves = [np.sin(21.0 * x + 3.0 * y), np.sin(17.0 * y - 5.0 * x), np.cos(12.0 * x) * np.cos(14.0 * y)]
    return (127.5 + 110.0 * np.stack(waves, axis=-1)).round().astype(np.uint8)


def pixels() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).reshape(-1, 1, 2).astype(np.float64)


def rays_of(model: str, coefficients: np.ndarray) -> np.ndarray:
    """The direction x/z, y/z (n, 2) of each pixel of a camera with distortion, by OpenCV's own inverse or by the
    model's definition, solved for the angle."""
    if model in ("angle_to_radius", "radius_to_angle"):
        x, y = ((pixels()[:, 0] - K[:2, 2]) * [1.0, K[0, 0] / K[1, 1]]).T
        radius = np.hypot(x, y)
        power = Polynomial([0.0, *coefficients])
        angles = power(radius) if model == "radius_to_angle" else radius / coefficients[0]
        for _ in range(50 if model == "angle_to_radius" else 0):
            angles = angles - (power(angles) - radius) / coefficients[0]
        return np.stack([x, y], axis=1) * (np.tan(angles) / np.maximum(radius, 1e-9))[:, None]
    if model == "fisheye":
        return cv2.fisheye.undistortPoints(pixels(), K, coefficients.reshape(4, 1))[:, 0]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    radial = coefficients[1:] if model == "mei" else coefficients
    x, y = cv2.undistortPointsIter(pixels(), K, radial, None, None, criteria)[:, 0].T
    if model != "mei":
        return np.stack([x, y], axis=1)
    xi, squared = coefficients[0], x**2 + y**2
    z = (xi + np.sqrt(1.0 + (1.0 - xi**2) * squared)) / (1.0 + squared)  # on the unit sphere
    return np.stack([z * x, z * y], axis=1) / (z - xi)[:, None]


@pytest.fixture
def scene(tiny_scene, tmp_path, request) -> Scene:
    """Two images of a distorted camera."""
    model, values = LENSES[request.param]
    coefficients = np.array(values)
    path = tmp_path / "recorded.png"
    Image.fromarray(seen(rays_of(model, coefficients).reshape(*SIZE[::-1], 2))).save(path)
    frames = tuple(
        dataclasses.replace(frame, image_path=str(path), width=SIZE[0], height=SIZE[1], intrinsics=K)
        for frame in tiny_scene.frames[:2]
    )
    camera = Camera("CAM_FRONT", *SIZE, K, coefficients, distortion_model=model)
    return dataclasses.replace(tiny_scene, frames=frames, cameras=(camera,))


@pytest.mark.parametrize("scene", LENSES, indirect=True)
def test_resampled_images_are_those_of_a_pinhole_camera(scene, tmp_path):
    straight = undistorted(scene, tmp_path / "straight")
    (camera,) = straight.cameras
    assert camera.distortion_model == "none" and not camera.distortion.any()
    k = camera.intrinsics
    central = K[0, 0] / (1.9 if scene.cameras[0].distortion_model == "mei" else 1.0)
    assert 0.999999 < k[0, 0] / central < 1.6 and (k[:2, 2] == K[:2, 2]).all()
    ideal = seen((pixels().reshape(SIZE[1], SIZE[0], 2) - k[:2, 2]) / k.diagonal()[:2])
    for frame in straight.frames:
        assert (frame.width, frame.height) == SIZE and (frame.intrinsics == k).all()
        assert frame.image_path == str(tmp_path / f"straight/CAM_FRONT/{frame.timestamp}.png")
        inner = np.s_[2:-2, 2:-2]  # at the border a source has no neighbour on one side
        error = (read_image(frame.image_path)[inner].astype(float) - ideal[inner]) ** 2
        assert 10.0 * np.log10(255.0**2 / error.mean()) > 38.0
    bent = 10.0 * np.log10(255.0**2 / ((read_image(scene.frames[0].image_path) - ideal.astype(float)) ** 2).mean())
    assert bent < 25.0, "the distortion is visible"


@pytest.mark.parametrize("scene", ["barrel", "pincushion"], indirect=True)
@pytest.mark.parametrize("direction", ["down", "right"])
def test_the_readout_time_is_that_of_the_part_of_the_image_that_is_left(scene, direction, tmp_path):
    camera = dataclasses.replace(scene.cameras[0], readout_s=0.04, readout_direction=direction)
    (straight,) = undistorted(dataclasses.replace(scene, cameras=(camera,)), tmp_path / "straight").cameras
    k, axis, side = straight.intrinsics, ("right", "down").index(direction), SIZE[("right", "down").index(direction)]
    middles = np.tile(k[:2, 2], (2, 1))
    middles[:, axis] = [0.25 * side, 0.75 * side]
    rays = np.column_stack([(middles - k[:2, 2]) / k.diagonal()[:2], np.ones(2)])
    sources, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, camera.distortion)
    expected = 0.04 * np.ptp(sources[:, 0, axis]) / (0.5 * side)
    assert straight.readout_s == pytest.approx(expected, rel=0.08) and straight.readout_direction == direction
    assert abs(straight.readout_s - 0.04) > 1e-4
    unknown = dataclasses.replace(camera, readout_direction=None)
    (straight,) = undistorted(dataclasses.replace(scene, cameras=(unknown,)), tmp_path / "straight").cameras
    assert straight.readout_s == 0.04


@pytest.mark.parametrize("scene", ["barrel"], indirect=True)
def test_other_cameras_stay_as_they_are_and_a_distortion_that_cannot_be_undone_is_named(scene, tiny_scene, tmp_path):
    assert undistorted(tiny_scene, tmp_path / "none").frames == tiny_scene.frames
    assert not (tmp_path / "none").exists()
    wild = dataclasses.replace(scene.cameras[0], distortion=np.array([1e7, 0.0, 0.0, 0.0]))
    with pytest.raises(DatasetError, match="camera CAM_FRONT: its distortion leaves no image"):
        undistorted(dataclasses.replace(scene, cameras=(wild,)), tmp_path / "straight")


def camera_of(model: str, values: list[float]) -> Camera:
    return Camera("CAM_FRONT", *SIZE, K, np.array(values), distortion_model=model)


@pytest.mark.parametrize("lens", [name for name, (model, _) in LENSES.items() if model in ("opencv", "fisheye")])
def test_the_part_of_the_view_that_is_kept_is_the_part_of_pixels_that_the_new_image_shows(lens):
    """By OpenCV's own inverse: recorded pixels whose direction falls into the new image."""
    camera = camera_of(*LENSES[lens])
    kept, k = view_kept(camera), _maps(camera)[0]
    seen_at = rays_of(camera.distortion_model, camera.distortion) * k.diagonal()[:2] + k[:2, 2]
    inside = ((seen_at >= -0.5) & (seen_at <= np.array(SIZE) - 0.5)).all(axis=1)
    assert abs(kept - inside.mean()) < 0.03 and kept < 1.0


@pytest.mark.parametrize(
    ("model", "values", "words"),
    [
        ("fisheye", [339.749, -31.988, 48.275, -7.201], "at 3 times its focal length; its coefficients are probably"),
        ("opencv", [0.001, -0.0005, -0.25, 0.06], "has p1 = -0.25 and p2 = 0.06, more than 0.1"),
        ("opencv", [-0.9, 0.0, 0.0, 0.0], "its distortion folds"),
    ],
)
def test_coefficients_of_another_model_are_refused_with_the_likely_cause(model, values, words):
    fault = distortion_fault(camera_of(model, values))
    assert fault and fault.startswith("camera CAM_FRONT: its distortion ") and words in fault
    assert not any(distortion_fault(camera_of(*lens)) for lens in LENSES.values())
