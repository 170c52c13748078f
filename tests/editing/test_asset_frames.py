"""Frames of assets: means, covariances and colours by direction turn together; bad frames are refused."""

from itertools import permutations, product

import numpy as np
import pytest
import torch
from helpers.hand_made_assets import CAR, filled_car, round_ones
from scipy.spatial.transform import Rotation

from drivesplat.editing.assets.formats import asset_harvester, hugsim, splatsim
from drivesplat.editing.assets.frames import AXES, AssetFrame, extent_of, misfit
from drivesplat.errors import RequestError
from drivesplat.kernels.gsplat_private import sh_basis
from drivesplat.model.gaussians import Gaussians

RIGHT_HANDED = [
    ",".join(words)
    for axes in permutations("xyz")
    for words in product(*((axis, f"-{axis}") for axis in axes))
    if np.linalg.det(np.stack([AXES[word] for word in words])) > 0.0
]
DECLARED = {asset_harvester.FRAME: "z -x -y", splatsim.FRAME: "x y z", hugsim.FRAME: "x z -y"}


def one_gaussian() -> Gaussians:
    """One of three lengths, with colours of degree 3 and LiDAR logits that depend on the direction."""
    generator = torch.Generator().manual_seed(2)
    sh = torch.randn(1, 16, 3, generator=generator)
    quats = torch.nn.functional.normalize(torch.randn(1, 4, generator=generator), dim=-1)
    means, scales = torch.tensor([[1.0, -2.0, 0.5]]), torch.tensor([[0.1, 0.4, 0.9]])
    plain = Gaussians.of(means, quats, scales, torch.tensor([0.7]), sh)
    return Gaussians(**plain.tensors, lidar_logits=torch.randn(1, 4, 2, generator=generator))


def covariance(gaussians: Gaussians) -> np.ndarray:
    turned = Rotation.from_quat(gaussians.quats.double().numpy(), scalar_first=True).as_matrix()[0]
    return turned @ np.diag(gaussians.scales[0].double().numpy() ** 2) @ turned.T


def seen_along(gaussians: Gaussians, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The colours and the LiDAR logits of one Gaussian along directions (n, 3)."""
    colors = sh_basis(16, torch.from_numpy(directions.copy())) @ gaussians.sh[0].double()
    logits = gaussians.lidar_logits[0].double().numpy()
    return colors.numpy(), logits[0] + directions @ logits[1:]


def test_there_are_24_frames():
    assert len(RIGHT_HANDED) == 24


@pytest.mark.parametrize("words", RIGHT_HANDED)
def test_place_covariance_and_colours_of_a_gaussian_turn_together(words):
    """The object's axes written out: what lies along the file's `forward` axis lies along x."""
    own, frame = one_gaussian(), AssetFrame.parse(words, 2.0)
    found = frame.to_object(own)
    forward, left, up = (
        (-1.0 if word[0] == "-" else 1.0) * np.eye(3)["xyz".index(word[-1])] for word in words.split(",")
    )
    place = own.means[0].double().numpy()
    np.testing.assert_allclose(found.means[0], 2.0 * np.array([place @ forward, place @ left, place @ up]), atol=1e-6)
    along = np.stack([forward, left, up], axis=1)
    np.testing.assert_allclose(covariance(found), 4.0 * along.T @ covariance(own) @ along, atol=1e-5)
    directions = Rotation.random(20, random_state=1).apply([1.0, 0.0, 0.0])
    for of_object, of_file in zip(seen_along(found, directions @ along), seen_along(own, directions), strict=True):
        np.testing.assert_allclose(of_object, of_file, atol=1e-5)
    back = frame.from_object(found)
    np.testing.assert_allclose(covariance(back), covariance(own), atol=1e-5)
    for name in ("means", "scales", "sh0", "shN", "lidar_logits", "opacities"):
        torch.testing.assert_close(back.tensors[name], own.tensors[name], atol=1e-5, rtol=1e-5)
    assert frame.words == words


@pytest.mark.parametrize(("words", "expected"), DECLARED.items())
def test_formats_declare_their_frames(words, expected):
    assert AssetFrame.parse(words).words.split(",") == expected.split()


@pytest.mark.parametrize(
    ("words", "scale", "said"),
    [
        ("x,y,-z", 1.0, "the frame 'x,y,-z' is mirrored"),
        ("z,x,-y", 1.0, "the frame 'z,x,-y' is mirrored"),
        ("x,x,z", 1.0, "the frame 'x,x,z' is not orthogonal"),
        ("x,-x,z", 1.0, "is not orthogonal"),
        ("x,y", 1.0, "is not three axes"),
        ("forward,left,up", 1.0, "is not three axes"),
        ("x,y,z", 0.0, "the scale 0 is not"),
        ("x,y,z", float("nan"), "the scale nan is not"),
    ],
)
def test_frames_that_cannot_be_are_refused_in_a_sentence(words, scale, said):
    with pytest.raises(RequestError) as refused:
        AssetFrame.parse(words, scale)
    assert said in str(refused.value) and "\n" not in str(refused.value)


def test_the_extent_is_that_of_opaque_gaussians_and_their_radius():
    middle, size = extent_of(filled_car(4000).gaussians)
    np.testing.assert_allclose(middle, 0.0, atol=0.05)
    np.testing.assert_allclose(size, CAR, atol=0.2)
    places = np.concatenate([np.full((50, 3), -1.0), np.full((50, 3), 2.0), np.full((1, 3), 99.0)])
    middle, size = extent_of(round_ones(places, (0.5, 0.5, 0.5), size=0.25))
    np.testing.assert_allclose(middle, 0.5, atol=1e-6)
    np.testing.assert_allclose(size, 3.5, atol=1e-6)


def test_gaussians_that_do_not_fit_their_box_are_named():
    gaussians = filled_car().gaussians
    assert misfit(gaussians, CAR) is None
    turned = AssetFrame.parse("y,-x,z").to_object(gaussians)
    said = misfit(turned, CAR)
    assert said.startswith("its Gaussians extend over 2") and "does not fit its box of 4 x 2 x 1.5 m" in said
    for scale in (0.2, 4.0):
        assert "does not fit its box" in misfit(AssetFrame.parse("x,y,z", scale).to_object(gaussians), CAR)
    raised = Gaussians(**{**gaussians.tensors, "means": gaussians.means + torch.tensor([0.0, 0.0, 0.75])})
    assert misfit(raised, CAR).startswith("the middle of its Gaussians is 0.7")
