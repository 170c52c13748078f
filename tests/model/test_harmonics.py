"""Spherical harmonics that turn with an object, against scipy's evaluated along directions in the object's frame."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from drivesplat.model.harmonics import rotated, rotation_of_harmonics, rotation_of_harmonics_by

ROTATIONS = Rotation.random(5, random_state=0).as_matrix()
COUNTS = [1, 4, 9, 16]
"""Coefficients of the degrees 0 to 3."""


def basis(directions: np.ndarray, coefficients: int) -> np.ndarray:
    """Real spherical harmonics (n, k) along unit directions (n, 3), in 3DGS' order and signs: of order m the real
    (m > 0) or imaginary (m < 0) part of the complex one with the Condon-Shortley phase."""
    polar, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for degree in range(int(np.sqrt(coefficients))):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            part = value.imag if order < 0 else value.real
            columns.append(part * (np.sqrt(2.0) if order else 1.0))
    return np.stack(columns, axis=1)


def random_directions(count: int = 200) -> np.ndarray:
    directions = np.random.default_rng(1).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def maps(rotations: np.ndarray, coefficients: int) -> np.ndarray:
    return rotation_of_harmonics(torch.from_numpy(rotations), coefficients).numpy()


@pytest.mark.parametrize("coefficients", COUNTS)
def test_rotated_coefficients_give_the_colours_of_the_object_frame(coefficients):
    """In double precision, and in single precision by the function for coefficients."""
    directions, sh = random_directions(), np.random.default_rng(2).normal(size=(coefficients, 3))
    for rotation, turned in zip(ROTATIONS, maps(ROTATIONS, coefficients) @ sh, strict=True):
        in_object = basis(directions @ rotation, coefficients) @ sh  # rows are R^T d
        np.testing.assert_allclose(basis(directions, coefficients) @ turned, in_object, atol=1e-5)
        single = rotated(torch.from_numpy(sh)[None].float(), torch.from_numpy(rotation))
        assert single.dtype == torch.float32
        np.testing.assert_allclose(single[0], turned, atol=1e-5)


@pytest.mark.parametrize("coefficients", COUNTS)
def test_a_mirrored_object_has_the_colours_of_its_other_side(coefficients):
    """Every second object is mirrored: along d it has the colour that it had along d with its own y reversed."""
    directions, sh = random_directions(), np.random.default_rng(3).normal(size=(coefficients, 3))
    quats = torch.from_numpy(Rotation.from_matrix(ROTATIONS).as_quat(scalar_first=True))
    side = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0]).double()
    turns = rotation_of_harmonics_by(quats, coefficients, side).numpy()
    for rotation, own, turned in zip(ROTATIONS, side.numpy(), turns @ sh, strict=True):
        in_object = basis(directions @ rotation * [1.0, own, 1.0], coefficients) @ sh
        np.testing.assert_allclose(basis(directions, coefficients) @ turned, in_object, atol=1e-5)


def test_degrees_do_not_mix_and_lose_nothing():
    """Not even by rounding: a degree that is not shown as yet must have no gradient that Adam could enlarge."""
    degrees = np.sqrt(np.arange(16)).astype(int)
    apart = degrees[:, None] != degrees[None]
    for turning in maps(ROTATIONS, 16):
        assert not turning[apart].any()
        np.testing.assert_allclose(turning @ turning.T, np.eye(16), atol=1e-6)
        assert turning[0, 0] == pytest.approx(1.0)
