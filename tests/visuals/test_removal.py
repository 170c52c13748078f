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
from drivesplat.scene.scene import Scene, Track
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


@pytest.mark.parametrize(
    ("place", "goes_without", "goes_with"),
    [
        pytest.param((0.0, 0.0, 0.0), True, True, id="in the middle"),
        pytest.param((1.9, -0.9, 0.7), True, True, id="in a corner"),
        pytest.param((2.05, 0.0, 0.0), False, True, id="before it, within the margin"),
        pytest.param((0.0, -1.08, 0.0), False, True, id="beside it, within the margin"),
        pytest.param((0.0, 0.0, 0.85), False, True, id="over it, within the margin"),
        pytest.param((2.15, 0.0, 0.0), False, False, id="before it, beyond the margin"),
        pytest.param((0.0, 1.15, 0.0), False, False, id="beside it, beyond the margin"),
        pytest.param((0.0, 0.0, 0.95), False, False, id="over it, beyond the margin"),
        pytest.param((0.0, 0.0, -0.79), True, True, id="right over the floor"),
        pytest.param((0.0, 0.0, -0.81), False, False, id="right under the floor: road"),
        pytest.param((2.05, 0.0, -0.81), False, False, id="road before it"),
    ],
)
@pytest.mark.parametrize("size", [0.01, 1.0])
def test_gaussians_with_their_centre_in_the_box_are_removed_at_any_size(place, goes_without, goes_with, size):
    """Places are the box's own coordinates; the margin 0.1 m grows sides and roof, not the floor."""
    box = turned_box()
    world = np.array(place) @ box.object_to_world[:3, :3].T + box.object_to_world[:3, 3]
    model = model_of(round_gaussians([world, [0.0, 0.0, 0.0]], size))
    for margin, goes in ((0.0, goes_without), (0.1, goes_with)):
        removal = removal_of(model, model.at(0.0), box, margin)
        assert removal.by == "box" and removal.removed.tolist() == [goes, False]


def test_of_an_actor_only_its_own_gaussians_are_removed():
    box = turned_box()
    middle = box.object_to_world[:3, 3]
    parts = round_gaussians([middle, middle + 50.0]), Own(round_gaussians([middle, middle + 9.0]), "it")
    model = model_of(*parts, Own(round_gaussians([middle]), "another"))
    removal = removal_of(model, model.at(0.0), box, 0.1)
    assert removal.by == "actor" and removal.removed.tolist() == [False, False, True, True, False]


def test_of_an_object_without_an_actor_the_box_is_emptied():
    box = turned_box()
    model = model_of(round_gaussians([box.object_to_world[:3, 3]]), Own(round_gaussians([[0.0, 0.0, 0.0]]), "another"))
    removal = removal_of(model, model.at(0.0), box, 0.1)
    assert removal.by == "box" and removal.removed.tolist() == [True, False]


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


def one_car(tiny_scene: Scene, speed: float = 4.0) -> Scene:
    """A car ahead, its centre at (8.5, 0, 0.8) at the first key frame."""
    times = tiny_scene.key_frame_timestamps
    places = [rigid(np.eye(3), np.array([8.5 + speed * (time - times[0]) * 1e-6, 0.0, 0.8])) for time in times]
    it = Track(
        "it", *classed("vehicle.car"), SIZE, times, np.arange(len(times)), np.stack(places), np.full(len(times), 4)
    )
    return dataclasses.replace(tiny_scene, tracks=(it,))


def drive_of(scene: Scene, *parts: Part, masks: Path | None = None) -> ModelWithRecording:
    return ModelWithRecording(model_of(*parts), recording_of(scene, masks), torch.device("cpu"))


def job_of(margin: float = 0.1, key_frame: int | None = 0) -> RemovalJob:
    return RemovalJob(
        eval_camera="CAM_FRONT",
        subject=SubjectSettings(key_frame=key_frame),
        ghosts=GhostSettings(),
        removal=RemovalSettings(margin=margin),
    )


CAR_AT = [8.4, 0.0, 0.8]
PLACES = [
    CAR_AT,
    [6.5, 0.6, 0.4],  # in the box
    [12.0, -1.8, 1.8],  # outside of it
    [8.4, 1.06, 1.2],  # its centre within the margin, half of it in the box
]


def test_only_gaussians_in_the_box_disappear_from_the_image(tiny_scene):
    part = round_gaussians(PLACES, 0.2, colors=[[0.0, 0.0, 0.0], [0.9, 0.1, 0.1], [0.1, 0.9, 0.1], [0.9, 0.9, 0.1]])
    pair, record = remove_actor(drive_of(one_car(tiny_scene), part), job_of())
    assert record["removed_by"] == "box" and record["gaussians_removed"] == 3 and record["margin_m"] == 0.1
    assert record["subject"]["track"] == "it" and record["key_frame"] == 0 and record["why_null"] is None
    kept = drive_of(one_car(tiny_scene), round_gaussians(PLACES[2:3], 0.2, colors=[[0.1, 0.9, 0.1]]))
    expected, _ = remove_actor(kept, job_of())
    np.testing.assert_allclose(pair.without_car, expected.with_car, atol=1e-6)
    np.testing.assert_allclose(pair.alpha_without, expected.alpha_with, atol=1e-6)
    assert np.abs(pair.with_car - pair.without_car).max() > 0.3
    json.dumps(record, allow_nan=False)


def test_without_a_margin_gaussians_across_the_boundary_stay(tiny_scene):
    _, record = remove_actor(drive_of(one_car(tiny_scene), round_gaussians(PLACES, 0.2)), job_of(margin=0.0))
    assert record["gaussians_removed"] == 2


def test_outside_the_footprint_both_images_are_equal(tiny_scene):
    random = np.random.default_rng(0)
    around = random.uniform([4.0, -4.0, 0.0], [30.0, 4.0, 4.0], (300, 3))
    part = round_gaussians(around, 0.25, opacities=0.7, colors=random.uniform(0, 1, (300, 3)).tolist())
    pair, record = remove_actor(drive_of(one_car(tiny_scene), part), job_of())
    off = ~pair.footprint
    assert record["gaussians_removed"] >= 5 and 0.2 < off.mean() < 0.95
    error = ((pair.with_car - pair.without_car)[off] ** 2).mean()
    assert error < 1e-9
    assert record["outside_footprint"]["pixels"] == off.sum()
    assert record["outside_footprint"].get("identical") or record["outside_footprint"]["psnr"] >= 90.0
    assert (np.abs(pair.with_car - pair.without_car) > 0.1).any()


def test_the_footprint_covers_the_removed_gaussian(tiny_scene):
    """One Gaussian of 0.2 m at 6.84 m from the camera: a disc around where its centre is projected."""
    pair, _ = remove_actor(drive_of(one_car(tiny_scene), round_gaussians([CAR_AT], 0.2)), job_of())
    frame = tiny_scene.frames[0]
    ahead, left, up = np.array(CAR_AT) - frame.camera_to_world[:3, 3]
    focal = frame.intrinsics[0, 0]
    u, v = 48.0 - focal * left / ahead, 27.0 - focal * up / ahead
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(54) + 0.5)
    distance = np.hypot(x - u, y - v)
    deviation = np.sqrt((focal * 0.2 / ahead) ** 2 + 0.3)
    assert pair.footprint[distance < 2.0 * deviation].all()
    assert not pair.footprint[distance > 4.0 * deviation].any()


BEFORE_THE_BOX = [5.5, 0.85, 0.4]
"""On the car's way, nearer than its box and beside it in the image."""
EGO_FROM_ROW = 36
"""The row from which on the ego vehicle's body hides what is in the image, the lower part of the car's box as well."""


def test_pixels_of_the_ego_mask_are_neither_inside_nor_outside(tiny_scene, tmp_path):
    labels = np.full((54, 96), LABELS["static"], dtype=np.uint8)
    labels[EGO_FROM_ROW:] = LABELS["own_car"]
    scene, part = one_car(tiny_scene, speed=6.0), round_gaussians([*PLACES, BEFORE_THE_BOX], 0.2)
    masks = write_labels(tmp_path, scene, labels)
    (whole, unmasked), (pair, record) = (
        remove_actor(drive_of(scene, part, masks=given), job_of()) for given in (None, masks)
    )
    np.testing.assert_array_equal(whole.outside, ~whole.inside)
    hidden = np.zeros((54, 96), dtype=bool)
    hidden[EGO_FROM_ROW:] = True
    for name in ("inside", "outside"):
        all_rows = getattr(whole, name)
        assert (all_rows & hidden).any() and (all_rows & ~hidden).any()
        np.testing.assert_array_equal(getattr(pair, name), all_rows & ~hidden)
    assert record["box"]["pixels"] == (whole.inside & ~hidden).sum() < unmasked["box"]["pixels"]
    assert record["outside"]["pixels"] == (whole.outside & ~hidden).sum()
    assert record["subject"]["pixels"] == (whole.inside & ~hidden).sum()
    error = ((pair.with_car - pair.without_car)[whole.outside & ~hidden] ** 2).mean()
    assert record["outside"]["psnr"] == pytest.approx(-10 * np.log10(error))
    assert [found["ghosts"]["gaussians"] for found in (record, unmasked)] == [1, 1]
    assert unmasked["ghosts"]["reach_outside_box"] and unmasked["ghosts"]["covered_share_outside"] > 0.0
    assert not record["ghosts"]["reach_outside_box"] and record["ghosts"]["covered_share_outside"] == 0.0


def ghosts_record(tiny_scene: Scene, place, opacity: float = 0.95) -> dict:
    places = [CAR_AT] if place is None else [CAR_AT, place]
    part = round_gaussians(places, 0.15, [0.95, opacity][: len(places)], [0.9, 0.2, 0.1])
    drive = drive_of(one_car(tiny_scene, speed=6.0), part)
    return remove_actor(drive, job_of())[1]["ghosts"]


@pytest.mark.parametrize(
    ("place", "count", "seen"),
    [
        pytest.param(None, 0, False, id="there are none"),
        pytest.param(BEFORE_THE_BOX, 1, True, id="on the way here, before the box in the image"),
        pytest.param([30.0, 0.0, 0.8], 1, False, id="on the way ahead, behind the box in the image"),
        pytest.param([12.0, 3.0, 0.8], 0, False, id="beside the way: no ghost"),
    ],
)
def test_remaining_ghosts_are_counted_and_their_visibility_outside_the_box_is_reported(tiny_scene, place, count, seen):
    record = ghosts_record(tiny_scene, place)
    assert record["gaussians"] == count and record["reach_outside_box"] is seen
    assert (record["covered_share_outside"] > 0) is seen
    assert record["opacity_mean"] == (pytest.approx(0.95, abs=1e-5) if count else None)


@pytest.mark.parametrize(("opacity", "seen"), [(0.04, False), (0.07, True)])
def test_ghosts_are_visible_from_an_opacity_of_a_twentieth(tiny_scene, opacity, seen):
    record = ghosts_record(tiny_scene, BEFORE_THE_BOX, opacity)
    assert record["gaussians"] == 1 and record["reach_outside_box"] is seen


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


@pytest.mark.parametrize("seed", range(3))
def test_the_edge_is_the_mean_gradient_along_the_hull_with_and_without(seed):
    pair = pair_of(seed)
    band = along_the_hull(pair.inside)
    before, after = gradient(pair.with_car)[band].mean(), gradient(pair.without_car)[band].mean()
    found = figures(pair)["edge"]
    assert found["with_car"] == pytest.approx(before) and found["without_car"] == pytest.approx(after)
    assert found["ratio"] == pytest.approx(after / before)


def test_a_box_that_fills_the_image_has_no_edge():
    everywhere = np.ones((HEIGHT, WIDTH), dtype=bool)
    found = figures(pair_of(inside=everywhere, outside=~everywhere))
    assert found["edge"]["ratio"] is None


@pytest.mark.parametrize("footprint", [True, False])
def test_a_footprint_of_everything_or_nothing(footprint):
    found = figures(pair_of(footprint=np.full((HEIGHT, WIDTH), footprint)))["outside_footprint"]
    assert found is None if footprint else found["pixels"] == HEIGHT * WIDTH
