"""Intrinsics that cannot be those of the images, and views of which resampling loses much."""

import dataclasses

import numpy as np
import pytest

from drivesplat.preprocess.intrinsics import intrinsics_warnings
from drivesplat.scene.scene import Scene
from drivesplat.scene.sensors import Camera

WIDE = np.array([0.02625958, 0.03141076, -0.01003215, 0.00107841])
"""A fisheye of 190 degrees, whose focal length is a quarter of the width."""


def scene_with(tiny_scene: Scene, k: list[list[float]], distortion: np.ndarray | None = None) -> Scene:
    model = "none" if distortion is None else "fisheye"
    camera = Camera("CAM_FRONT", 480, 270, np.array(k), distortion, distortion_model=model)
    return dataclasses.replace(tiny_scene, cameras=(camera,))


@pytest.mark.parametrize(("scale", "size"), [(1.0 / 0.75, "640x360"), (0.75, "360x202"), (10.0 / 3.0, "1600x900")])
def test_a_matrix_of_another_image_size_is_named_with_the_size_that_it_fits(tiny_scene, scale, size):
    k = [[377.0 * scale, 0.0, 240.0 * scale - 0.5], [0.0, 377.0 * scale, 135.0 * scale - 0.5], [0.0, 0.0, 1.0]]
    (sentence,) = intrinsics_warnings(scene_with(tiny_scene, k))
    assert f"of about {size} instead of 480x270 pixels" in sentence and sentence.startswith("camera CAM_FRONT: ")


@pytest.mark.parametrize("middle", [(239.5, 134.5), (240.0, 75.0)], ids=["fitting", "cut at the top"])
def test_a_matrix_of_the_images_is_not_warned_of(tiny_scene, middle):
    assert intrinsics_warnings(scene_with(tiny_scene, [[377.0, 0, middle[0]], [0, 377.0, middle[1]], [0, 0, 1]])) == []


def test_the_part_of_a_wide_view_that_is_kept_is_said(tiny_scene):
    wide = [[125.0, 0, 240.0], [0, 125.0, 135.0], [0, 0, 1]]
    (sentence,) = intrinsics_warnings(scene_with(tiny_scene, wide, WIDE))
    assert "camera CAM_FRONT: pinhole images keep " in sentence and "of the area of its fisheye images" in sentence
    narrow = [[600.0, 0, 240.0], [0, 600.0, 135.0], [0, 0, 1]]
    assert intrinsics_warnings(scene_with(tiny_scene, narrow, WIDE)) == []
