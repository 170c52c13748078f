"""The sides of an asset that no camera saw, mirrored from others or filled with a hull, and pictures from all sides."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.hand_made import looking_at, round_gaussians
from helpers.hand_made_assets import BLUE, CAR, RED, asset_of, painted_box, plate, rgb_of, round_ones
from helpers.hand_made_traffic import some_gaussians
from PIL import Image

from drivesplat.editing.assets.asset import Asset
from drivesplat.editing.assets.completion import completed, facing_azimuths, filled, mirrored, seen_from
from drivesplat.editing.assets.turntable import BACKDROP, VIEWS, AssetView, seen_asset, turntable, write_turntable
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.object_class import ObjectClass

LEFT, RIGHT, BEHIND = np.array([np.pi / 2.0]), np.array([-np.pi / 2.0]), np.array([np.pi])
ALL_AROUND = np.radians(np.arange(0.0, 360.0, 10.0))


def with_echoes(gaussians: Gaussians, seed: int = 0) -> Gaussians:
    logits = torch.randn(len(gaussians), 4, 2, generator=torch.Generator().manual_seed(seed))
    return replace(gaussians, lidar_logits=logits)


# ---- mirror images


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_mirror_image_of_a_mirror_image_is_the_original(degree):
    original = with_echoes(some_gaussians(20, degree, seed=2))
    once, twice = mirrored(original), mirrored(mirrored(original))
    for name, values in original.tensors.items():
        torch.testing.assert_close(twice.tensors[name], values, atol=1e-5, rtol=1e-5)
    assert torch.equal(once.means[:, 1], -original.means[:, 1])
    assert degree == 0 or not torch.allclose(once.shN, original.shN, atol=1e-2)


@pytest.mark.parametrize("degree", [1, 2])
def test_a_mirrored_camera_sees_of_mirrored_gaussians_the_image_left_for_right(degree):
    """Long Gaussians, turned in all directions, whose colours depend on the direction."""
    original, model = some_gaussians(12, degree, seed=7), SplatModel([round_gaussians([[0.0, 0.0, 0.0]])], None)
    from_left, from_right = (looking_at([0.0, 0.0, 0.3], [6.0, side * 4.0, 2.0]) for side in (1.0, -1.0))
    there = model.render(from_left, gaussians=original).image
    image = model.render(from_right, gaussians=mirrored(original)).image
    torch.testing.assert_close(image.flip(1), there, atol=1e-4, rtol=0.0)
    wrong = replace(mirrored(original), quats=original.quats), replace(mirrored(original), shN=original.shN)
    for own in (original, *wrong):
        assert (model.render(from_right, gaussians=own).image.flip(1) - there).abs().max() > 0.02


def test_the_echo_of_a_mirror_image_is_that_of_the_original_from_the_mirrored_direction():
    original = with_echoes(some_gaussians(6, 0, seed=3))
    toward = torch.tensor([0.6, 0.64, -0.48])
    found, expected = (
        own[:, 0] + (direction[:, None] * own[:, 1:]).sum(dim=1)
        for own, direction in (
            (mirrored(original).lidar_logits, toward * torch.tensor([1.0, -1.0, 1.0])), (original.lidar_logits, toward)
        )
    )  # fmt: skip
    torch.testing.assert_close(found, expected)


# ---- sides whose mirror image was seen


def color_of_side(gaussians: Gaussians, sign: int) -> torch.Tensor:
    """The colours that occur on the left (1) or the right (-1) in the middle of a car."""
    rows = (gaussians.means[:, 1] * sign > 0.9) & (gaussians.means[:, 0].abs() < 0.3)
    return rgb_of(gaussians[rows]).unique(dim=0)


@pytest.mark.parametrize(("seen", "sign", "color"), [(LEFT, -1, RED), (RIGHT, 1, BLUE)], ids=["left", "right"])
def test_a_side_that_was_not_seen_is_the_mirror_image_of_the_other(seen, sign, color):
    box = painted_box(seen=seen)
    whole = completed(box)
    for side in (1, -1):
        torch.testing.assert_close(color_of_side(whole.gaussians, side), torch.tensor([color]), atol=1e-4, rtol=0.0)
    middle = whole.gaussians.means[:, 0].abs() < 0.3
    on_the_unseen = whole.gaussians.means[:, 1] * sign > 0.9
    assert whole.invented[middle & on_the_unseen].all() and not whole.invented[middle & ~on_the_unseen].any()
    assert len(whole.gaussians) == len(box.gaussians) == len(whole.invented), "a side for a side"


def test_what_is_seen_from_one_side_stays_as_it_is():
    box = painted_box(seen=LEFT)
    whole = completed(box)
    kept = whole.gaussians[~whole.invented]
    own = seen_from(facing_azimuths(box.gaussians.means, CAR), LEFT)
    expected = box.gaussians[own | ~seen_from(-facing_azimuths(box.gaussians.means, CAR), LEFT)]
    assert torch.equal(kept.means, expected.means) and torch.equal(kept.sh0, expected.sh0)


def test_sides_whose_mirror_image_was_not_seen_either_stay():
    """The front and the back, of a car seen from its left."""
    box = painted_box(seen=LEFT)
    whole = completed(box)
    for own in (box, whole):
        ends = (own.gaussians.means[:, 0].abs() > 1.99) & (own.gaussians.means[:, 1].abs() < 0.2)
        assert ends.sum() == 2 * 4 * 15 and not own.invented[ends].any()


def test_a_copied_side_has_echoes_and_what_was_invented_before_stays_marked():
    box = painted_box(seen=LEFT)
    marked = box.gaussians.means[:, 0] > 1.99
    whole = completed(replace(box, gaussians=with_echoes(box.gaussians), invented=marked))
    assert whole.gaussians.lidar_logits.shape == (len(whole.gaussians), 4, 2)
    assert whole.invented[(whole.gaussians.means[:, 0] > 1.99) & (whole.gaussians.means[:, 1].abs() < 0.2)].all()


@pytest.mark.parametrize("seen", [np.zeros(0), ALL_AROUND, np.array([0.0, np.pi])], ids=["unknown", "all", "both ends"])
def test_nothing_changes_where_the_sides_are_unknown_or_alike(seen):
    box = painted_box(seen=seen)
    assert completed(box) is box


# ---- hulls


@pytest.fixture(scope="module")
def rear() -> Asset:
    """A car of which only the back is known, blue below and red above."""
    places = plate(0, -1, spacing=0.08)
    colors = np.where(places[:, 2:] < 0.0, BLUE, RED)
    return asset_of(round_ones(places, colors.tolist()), seen=BEHIND)


@pytest.fixture(scope="module")
def whole(rear) -> Asset:
    return filled(rear)


def nearest(asset: Asset, azimuth: float) -> torch.Tensor:
    """The depth (h, w) of what a camera sees, 0 where it sees nothing."""
    return seen_asset(asset, [AssetView(azimuth, np.radians(3.0), 4.0)])[0][0].surface_depth


def test_a_hull_is_not_seen_from_where_the_car_was_seen(rear, whole):
    camera = AssetView(np.pi, np.radians(3.0), 4.0)
    before, after = (seen_asset(asset, [camera])[0][0] for asset in (rear, whole))
    assert len(whole.gaussians) > 2 * len(rear.gaussians)
    inside = before.alpha > 0.9
    difference = (after.splats - before.splats).abs().amax(dim=2)
    assert difference[inside].mean() < 0.01 and difference.mean() < 0.01
    assert torch.equal(whole.gaussians.means[: len(rear.gaussians)], rear.gaussians.means)
    assert not whole.invented[: len(rear.gaussians)].any() and whole.invented[len(rear.gaussians) :].all()


def test_a_hull_closes_the_car_at_its_front_within_its_box(rear, whole):
    camera = AssetView(0.0, np.radians(3.0), 4.0)
    ((picture, view),) = seen_asset(whole, [camera])
    assert float(picture.alpha[view.height // 2, view.width // 2]) > 0.95
    depths = [float(nearest(asset, 0.0)[view.height // 2, view.width // 2]) for asset in (whole, rear)]
    away = 4.0 * np.linalg.norm(CAR)
    assert depths[0] == pytest.approx(away - 2.0, abs=0.9), "a windscreen is further back than the bonnet"
    assert depths[1] == pytest.approx(away + 2.0, abs=0.1), "without hull the back is seen from within"
    added = whole.gaussians[whole.invented]
    assert (added.means.abs() <= torch.from_numpy(CAR / 2.0)).all()
    assert float(added.means[:, 2].min()) > -0.75 + 0.1 * 1.5, "above the ground"


def test_a_hull_has_the_colours_and_the_echoes_that_were_seen_at_its_height(rear):
    echoes = torch.zeros(len(rear.gaussians), 4, 2)
    echoes[:, 0] = torch.tensor([-1.5, 3.0])
    found = filled(replace(rear, gaussians=replace(rear.gaussians, lidar_logits=echoes)))
    added = found.gaussians[found.invented]
    low, high = added.means[:, 2] < -0.2, added.means[:, 2] > 0.2
    assert low.any() and high.any()
    for rows, color in ((low, BLUE), (high, RED)):
        torch.testing.assert_close(rgb_of(added[rows]), torch.tensor(color).expand(int(rows.sum()), 3))
    assert (added.lidar_logits[:, 0] == torch.tensor([-1.5, 3.0])).all() and not added.lidar_logits[:, 1:].any()


def test_a_hull_has_the_harmonics_of_the_asset_and_no_colours_by_direction(rear):
    directed = replace(rear.gaussians, shN=torch.full((len(rear.gaussians), 3, 3), 0.1))
    found = filled(replace(rear, gaussians=directed))
    assert found.gaussians.sh_degree == 1 and not found.gaussians.shN[found.invented].any()


def test_only_a_car_has_a_cabin():
    """At the height of a roof a car is shorter than a truck."""
    places, lengths = plate(0, -1, spacing=0.08), {}
    for kind in (ObjectClass.CAR, ObjectClass.TRUCK):
        found = filled(asset_of(round_ones(places, RED), seen=BEHIND, object_class=kind))
        added = found.gaussians.means[found.invented]
        lengths[kind] = float(np.ptp(added[added[:, 2] > 0.4, 0].numpy()))
    assert lengths[ObjectClass.CAR] < 3.0 < lengths[ObjectClass.TRUCK]


@pytest.mark.parametrize(
    "changes",
    [{"object_class": ObjectClass.PEDESTRIAN, "seen": BEHIND}, {"object_class": ObjectClass.BICYCLE, "seen": BEHIND},
     {"seen": np.zeros(0)}, {"seen": ALL_AROUND}, {"seen": np.array([0.0, 1.6, np.pi])}],
    ids=["a person", "a bicycle", "unknown sides", "all sides", "all but the right"],
)  # fmt: skip
def test_nothing_is_filled_where_a_box_would_be_wrong_or_is_known(changes):
    box = painted_box(**changes)
    assert filled(box) is box


# ---- pictures


def middle(picture: np.ndarray) -> np.ndarray:
    height, width, _ = picture.shape
    return (
        picture[height // 2 - 3 : height // 2 + 3, width // 2 - 3 : width // 2 + 3].reshape(-1, 3).mean(axis=0) / 255.0
    )


def test_a_turntable_goes_round_to_the_left_from_the_front():
    """Seen from the front, the left of the car is on the right of the picture."""
    pictures = turntable(painted_box(), views=4)
    for picture, color in zip(pictures, ((0.1, 0.7, 0.1), RED, (0.9, 0.9, 0.9), BLUE), strict=True):
        np.testing.assert_allclose(middle(picture), color, atol=0.06)
    corner = turntable(painted_box(), views=8)[1].astype(int)
    is_red, is_green = (corner[..., i] - corner[..., j] > 80 for i, j in ((0, 1), (1, 0)))
    columns = np.arange(corner.shape[1])[None].repeat(corner.shape[0], axis=0)
    assert is_red.any() and is_green.any() and columns[is_red].mean() > columns[is_green].mean()
    np.testing.assert_array_equal(pictures[0][0, 0], round(255 * BACKDROP))


def test_a_turntable_stays_in_the_picture_and_has_all_views(tmp_path):
    pictures = turntable(painted_box())
    assert len(pictures) == VIEWS
    for picture in pictures:
        edge = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        assert (edge == round(255 * BACKDROP)).all()
        assert (np.abs(picture.astype(int) - round(255 * BACKDROP)).max(axis=2) > 20).mean() > 0.1
    write_turntable(tmp_path / "turn.webp", painted_box())
    written = Image.open(tmp_path / "turn.webp")
    assert written.n_frames == VIEWS
    written.seek(VIEWS // 4)
    np.testing.assert_allclose(middle(np.asarray(written.convert("RGB"))), RED, atol=0.1)
