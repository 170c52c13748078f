"""Removal of a vehicle from a model of a few Gaussians, and its figures."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.classed import classed
from helpers.hand_made import Own, recording_of, round_gaussians, write_labels
from scipy.ndimage import convolve

from drivesplat.model.part import Part, RigidGroup
from drivesplat.model.removal import removal_of
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.regions import LABELS, fill
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import Box
from drivesplat.settings.visuals import GhostSettings, RemovalJob, RemovalSettings, SubjectSettings
from drivesplat.visuals.removal import RemovalPair, figures, remove_actor
from drivesplat.visuals.rendered_view import ModelWithRecording

SIZE = np.array([4.0, 2.0, 1.6])
SKY = torch.tensor([0.2, 0.4, 0.7])


def model_of(*parts: Part) -> SplatModel:
    return SplatModel(parts, ConstantSky(SKY, 1e-2)).requires_grad_(False)


def turned_box(angle: float = 0.7) -> Box:
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return Box("it", *classed("vehicle.car"), SIZE, rigid(turn, np.array([30.0, -7.0, 1.2])), 5.0, 4)


@pytest.mark.parametrize("size", [0.01, 1.0])
def test_gaussians_with_their_centre_in_the_box_are_removed_at_any_size(size):
    """Places are the box's own coordinates; the margin 0.1 m grows sides and roof, not the floor."""
    inside = [[0.0, 0.0, 0.0], [1.9, -0.9, 0.7], [0.0, 0.0, -0.79]]
    within_the_margin = [[2.05, 0.0, 0.0], [0.0, -1.08, 0.0], [0.0, 0.0, 0.85]]
    beyond_the_margin = [[2.15, 0.0, 0.0], [0.0, 1.15, 0.0], [0.0, 0.0, 0.95]]
    road = [[0.0, 0.0, -0.81], [2.05, 0.0, -0.81]]
    box = turned_box()
    places = np.array([*inside, *within_the_margin, *beyond_the_margin, *road])
    world = places @ box.object_to_world[:3, :3].T + box.object_to_world[:3, 3]
    away = [[0.0, 0.0, 0.0]]
    model = model_of(round_gaussians([*world, *away], size), Own(round_gaussians(away), "another"))
    for margin, count in ((0.0, 3), (0.1, 6)):
        removal = removal_of(model, model.at(0.0), box, margin)
        assert removal.by == "box" and removal.removed.tolist() == [True] * count + [False] * (13 - count)


def test_of_an_actor_only_its_own_gaussians_are_removed():
    box = turned_box()
    middle = box.object_to_world[:3, 3]
    parts = round_gaussians([middle, middle + 50.0]), Own(round_gaussians([middle, middle + 9.0]), "it")
    model = model_of(*parts, Own(round_gaussians([middle]), "another"))
    removal = removal_of(model, model.at(0.0), box, 0.1)
    assert removal.by == "actor" and removal.removed.tolist() == [False, False, True, True, False]


class Discovered(Own):
    """An object that no annotated track knows."""

    has_objects = True

    def rigid_groups(self, time: float) -> dict[str, RigidGroup]:
        return {self._track_id: RigidGroup(self.sample(self.state(time)), None)}


@pytest.mark.parametrize(("outside", "by"), [(1, "actor"), (3, "box")])
def test_a_discovered_object_is_removed_as_a_whole_if_most_of_it_lies_in_the_box(outside, by):
    """Two of its Gaussians lie in the box, and so many do not."""
    box = turned_box()
    middle = box.object_to_world[:3, 3]
    found = Discovered(round_gaussians([middle, middle, *[middle + 9.0] * outside]), "found_0001")
    model = model_of(round_gaussians([middle]), found, Discovered(round_gaussians([middle + 30.0]), "found_0002"))
    removal = removal_of(model, model.at(0.0), box, 0.1)
    own = [True] * (2 + outside) if by == "actor" else [True, True, *[False] * outside]
    assert removal.by == by and removal.removed.tolist() == [by == "box", *own, False]


@pytest.fixture(scope="module")
def scene(one_car) -> Scene:
    """A car ahead, at 4 m/s."""
    return one_car(4.0, 8.5, 0.0)


@pytest.fixture(scope="module")
def faster(one_car) -> Scene:
    return one_car(6.0, 8.5, 0.0)


def removed(scene: Scene, part: Part, masks: Path | None = None, margin: float = 0.1) -> tuple[RemovalPair, dict]:
    """The removal of the car of a scene from the image of the first key frame."""
    job = RemovalJob(
        eval_camera="CAM_FRONT",
        subject=SubjectSettings(key_frame=0),
        ghosts=GhostSettings(),
        removal=RemovalSettings(margin=margin),
    )
    return remove_actor(ModelWithRecording(model_of(part), recording_of(scene, masks), torch.device("cpu")), job)


def test_only_gaussians_in_the_box_disappear_from_the_image(scene):
    part = round_gaussians(PLACES, 0.2, colors=[[0.0, 0.0, 0.0], [0.9, 0.1, 0.1], [0.1, 0.9, 0.1], [0.9, 0.9, 0.1]])
    pair, record = removed(scene, part)
    assert record["removed_by"] == "box" and record["gaussians_removed"] == 3 and record["margin_m"] == 0.1
    assert record["subject"]["track"] == "it" and record["key_frame"] == 0 and record["why_null"] is None
    expected, _ = removed(scene, round_gaussians(PLACES[2:3], 0.2, colors=[[0.1, 0.9, 0.1]]))
    np.testing.assert_allclose(pair.without_car, expected.with_car, atol=1e-6)
    np.testing.assert_allclose(pair.alpha_without, expected.alpha_with, atol=1e-6)
    assert np.abs(pair.with_car - pair.without_car).max() > 0.3
    json.dumps(record, allow_nan=False)
    assert removed(scene, part, margin=0.0)[1]["gaussians_removed"] == 2, "one is across the boundary"


def test_outside_the_footprint_both_images_are_equal(scene):
    random = np.random.default_rng(0)
    around = random.uniform([4.0, -4.0, 0.0], [30.0, 4.0, 4.0], (300, 3))
    part = round_gaussians(around, 0.25, opacities=0.7, colors=random.uniform(0, 1, (300, 3)).tolist())
    pair, record = removed(scene, part)
    off, outside = ~pair.footprint, record["outside_footprint"]
    assert record["gaussians_removed"] >= 5 and 0.2 < off.mean() < 0.95
    assert ((pair.with_car - pair.without_car)[off] ** 2).mean() < 1e-9
    assert outside["pixels"] == off.sum() and (outside.get("identical") or outside["psnr"] >= 90.0)
    assert (np.abs(pair.with_car - pair.without_car) > 0.1).any()


def test_the_footprint_covers_the_removed_gaussian(scene):
    """One Gaussian of 0.2 m at 6.84 m from the camera: a disc around where its centre is projected."""
    pair, _ = removed(scene, round_gaussians([CAR_AT], 0.2))
    frame = scene.frames[0]
    ahead, left, up = np.array(CAR_AT) - frame.camera_to_world[:3, 3]
    focal = frame.intrinsics[0, 0]
    u, v = 48.0 - focal * left / ahead, 27.0 - focal * up / ahead
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(54) + 0.5)
    distance = np.hypot(x - u, y - v)
    deviation = np.sqrt((focal * 0.2 / ahead) ** 2 + 0.3)
    assert pair.footprint[distance < 2.0 * deviation].all()
    assert not pair.footprint[distance > 4.0 * deviation].any()


CAR_AT = [8.4, 0.0, 0.8]
PLACES = [
    CAR_AT,
    [6.5, 0.6, 0.4],  # in the box
    [12.0, -1.8, 1.8],  # outside of it
    [8.4, 1.06, 1.2],  # its centre within the margin, half of it in the box
]


BEFORE_THE_BOX = [5.5, 0.85, 0.4]
"""On the car's way, nearer than its box and beside it in the image."""
EGO_FROM_ROW = 36
"""The row from which on the ego vehicle's body hides what is in the image, the lower part of the car's box as well."""


def test_pixels_of_the_ego_mask_are_neither_inside_nor_outside(faster, tmp_path):
    labels = np.full((54, 96), LABELS["static"], dtype=np.uint8)
    labels[EGO_FROM_ROW:] = LABELS["own_car"]
    part, hidden = round_gaussians([*PLACES, BEFORE_THE_BOX], 0.2), labels == LABELS["own_car"]
    masks = write_labels(tmp_path, faster, labels)
    (whole, unmasked), (pair, record) = (removed(faster, part, given) for given in (None, masks))
    np.testing.assert_array_equal(whole.outside, ~whole.inside)
    for name in ("inside", "outside"):
        all_rows = getattr(whole, name)
        assert (all_rows & hidden).any() and (all_rows & ~hidden).any()
        np.testing.assert_array_equal(getattr(pair, name), all_rows & ~hidden)
    assert record["box"]["pixels"] == record["subject"]["pixels"] == pair.inside.sum() < unmasked["box"]["pixels"]
    error = ((pair.with_car - pair.without_car)[pair.outside] ** 2).mean()
    assert record["outside"]["psnr"] == pytest.approx(-10 * np.log10(error))
    assert record["outside"]["pixels"] == pair.outside.sum()
    assert [found["ghosts"]["gaussians"] for found in (record, unmasked)] == [1, 1]
    assert unmasked["ghosts"]["reach_outside_box"] and unmasked["ghosts"]["covered_share_outside"] > 0.0
    assert not record["ghosts"]["reach_outside_box"] and record["ghosts"]["covered_share_outside"] == 0.0


@pytest.mark.parametrize(
    ("place", "opacity", "count", "seen"),
    [
        pytest.param(None, 0.95, 0, False, id="there are none"),
        pytest.param(BEFORE_THE_BOX, 0.95, 1, True, id="on the way here, before the box in the image"),
        pytest.param([30.0, 0.0, 0.8], 0.95, 1, False, id="on the way ahead, behind the box in the image"),
        pytest.param([12.0, 3.0, 0.8], 0.95, 0, False, id="beside the way: no ghost"),
        pytest.param(BEFORE_THE_BOX, 0.04, 1, False, id="less opaque than a twentieth"),
        pytest.param(BEFORE_THE_BOX, 0.07, 1, True, id="more opaque than a twentieth"),
    ],
)
def test_remaining_ghosts_are_counted_and_their_visibility_outside_the_box_is_reported(
    faster, place, opacity, count, seen
):
    places = [CAR_AT] if place is None else [CAR_AT, place]
    part = round_gaussians(places, 0.15, [0.95, opacity][: len(places)], [0.9, 0.2, 0.1])
    record = removed(faster, part)[1]["ghosts"]
    assert record["gaussians"] == count and record["reach_outside_box"] is seen
    assert (record["covered_share_outside"] > 0) is seen
    assert record["opacity_mean"] == (pytest.approx(opacity, abs=1e-5) if count else None)


HEIGHT, WIDTH = 30, 40
HULL = np.array([[10.0, 8.0], [24.0, 8.0], [24.0, 20.0], [10.0, 20.0]])


def pair_of(seed: int = 0, **changes) -> RemovalPair:
    """Two images that differ in a block across the hull's right side, and in one far pixel."""
    random = np.random.default_rng(seed)
    before = random.uniform(0.3, 0.6, (HEIGHT, WIDTH, 3))
    after = before.copy()
    after[12:16, 20:29, 1] += 0.2
    after[9, 11] += 0.02
    alpha = np.full((HEIGHT, WIDTH), 0.9)
    holes = alpha.copy()
    holes[12:15, 20:23] = 0.3
    inside = fill(HULL, (WIDTH, HEIGHT))
    footprint = np.zeros((HEIGHT, WIDTH), dtype=bool)
    footprint[12:16, 20:29] = footprint[9, 11] = True
    pair = RemovalPair(before, after, alpha, holes, footprint, inside, ~inside, HULL)
    return dataclasses.replace(pair, **changes)


def test_changed_shares_and_reach_of_a_synthetic_pair():
    """The hull is columns 10 to 23 and rows 8 to 19; columns 24 to 28 of the block lie outside."""
    found = figures(pair_of())
    assert found["box"]["pixels"] == 14 * 12
    assert found["box"]["changed_share"] == pytest.approx(4 * 4 / (14 * 12))
    assert found["outside"]["changed_share"] == pytest.approx(4 * 5 / (HEIGHT * WIDTH - 14 * 12))
    assert found["outside"]["reach_px"] == pytest.approx(5.0)
    error = 4 * 5 * 0.2**2 / 3 / (HEIGHT * WIDTH - 14 * 12)
    assert found["outside"]["psnr"] == pytest.approx(-10 * np.log10(error))
    assert found["outside_footprint"] == {
        "psnr": None, "identical": True, "pixels": HEIGHT * WIDTH - 4 * 9 - 1,
    }  # fmt: skip


def test_holes_are_pixels_whose_opacity_falls():
    alpha, after = np.full((HEIGHT, WIDTH), 0.9), np.full((HEIGHT, WIDTH), 0.9)
    alpha[:, :12] = 0.2
    after[10, 10:20] = 0.1  # two of ten had no surface before
    after[25, 30] = 0.49  # outside of the box
    after[11, 15] = 0.51
    found = figures(pair_of(alpha_with=alpha, alpha_without=after))["holes"]
    assert found["pixels"] == 9
    assert found["share_of_box"] == pytest.approx(8 / 168)


def test_the_edge_is_the_mean_gradient_along_the_hull_with_and_without():
    pair = pair_of(1)
    band = along_the_hull(pair.inside)
    before, after = gradient(pair.with_car)[band].mean(), gradient(pair.without_car)[band].mean()
    found = figures(pair)["edge"]
    assert found["with_car"] == pytest.approx(before) and found["without_car"] == pytest.approx(after)
    assert found["ratio"] == pytest.approx(after / before)


def test_a_box_that_fills_the_image_has_no_edge_and_a_footprint_of_everything_no_outside():
    everywhere = np.ones((HEIGHT, WIDTH), dtype=bool)
    assert figures(pair_of(inside=everywhere, outside=~everywhere))["edge"]["ratio"] is None
    assert figures(pair_of(footprint=everywhere))["outside_footprint"] is None
    assert figures(pair_of(footprint=~everywhere))["outside_footprint"]["pixels"] == HEIGHT * WIDTH


def gradient(image: np.ndarray) -> np.ndarray:
    """Sobel's magnitude of the luminance (ITU-R BT.709), over sqrt(2), borders repeated."""
    grey = image @ np.array([0.2125, 0.7154, 0.0721])
    kernel = np.outer([1.0, 2.0, 1.0], [1.0, 0.0, -1.0]) / 4.0
    return np.sqrt((convolve(grey, kernel) ** 2 + convolve(grey, kernel.T) ** 2) / 2.0)


def along_the_hull(inside: np.ndarray) -> np.ndarray:
    """Pixels no more than two pixels away from one on the other side."""
    places = np.argwhere(np.ones_like(inside)).astype(float)
    away = np.linalg.norm(places[:, None] - places[None], axis=-1)
    other = inside.ravel()[:, None] != inside.ravel()[None]
    return (np.where(other, away, np.inf).min(axis=1) <= 2.0).reshape(inside.shape)
