"""Shadows of inserted objects on the ground, and the brightness of the ground, to which their colours are matched."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hand_made import about_z, looking_at, round_gaussians
from helpers.hand_made_assets import CAR, painted_box, rgb_of
from helpers.hand_made_street import street_actors

from drivesplat.editing.assets.ground import MAX_GAIN, ground_color, matching_gains
from drivesplat.editing.assets.inserted import with_assets
from drivesplat.editing.placed_model import BELOW, LAYER, PlacedModel, shaded
from drivesplat.errors import ResultError
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.scene.light import RIM, SceneLight, Shade, direction, read_light, write_light
from drivesplat.scene.rigid import rigid

CONTACT, CAST = 0.2, 0.5
FROM_LEFT = SceneLight(CONTACT, CAST, azimuth_deg=90.0, elevation_deg=45.0)
"""The sun stands to the left of the world's x axis: shadows of a height of 1.5 m reach 1.5 m to the right."""
DULL = SceneLight(CONTACT)
POSE = rigid(np.eye(3), np.array([20.0, 0.0, 0.75]))
"""Of a car on the ground, at z = 0, that looks along x."""


def ground(places: Any, size: float = 0.02) -> Gaussians:
    """Small round Gaussians at places (n, 3) relative to the point below the car, with colours by direction."""
    places = np.asarray(places, dtype=np.float32).reshape(-1, 3)
    generator = torch.Generator().manual_seed(5)
    return Gaussians(
        torch.from_numpy(places + np.array([20.0, 0.0, 0.0], dtype=np.float32)),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(places), 1),
        torch.full((len(places), 3), size),
        torch.full((len(places),), 0.9),
        0.5 * torch.randn(len(places), 1, 3, generator=generator),
        0.2 * torch.randn(len(places), 3, 3, generator=generator),
    )


def kept(own: Gaussians, light: SceneLight = DULL, pose: np.ndarray = POSE) -> np.ndarray:
    """The share of brightness that each keeps: that of all its colours and channels."""
    found = shaded(own, [(pose, Shade(CAR, light))])
    shares = torch.cat([rgb_of(found) / rgb_of(own), (found.shN / own.shN).flatten(1)], dim=1)
    torch.testing.assert_close(shares, shares[:, :1].expand_as(shares), atol=1e-4, rtol=1e-4)
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(found, name), getattr(own, name)), name
    return shares[:, 0].numpy()


def test_ground_at_the_rim_of_a_box_loses_the_contact_shadow_and_below_it_at_least_half():
    """Half a length is 2 m, half a width 1 m; the shadow falls to 1/e within RIM heights."""
    places = [[2.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0 + RIM * 1.5, 0.0], [0.0, 0.0, 0.0], [1.9, 0.9, 0.0]]
    expected = [1.0 - CONTACT, 1.0 - CONTACT, 1.0 - CONTACT / np.e, 1.0 - BELOW, 1.0 - CONTACT]
    np.testing.assert_allclose(kept(ground(places)), expected, atol=1e-3)
    np.testing.assert_allclose(kept(ground([[0.0, 0.0, 0.0]]), SceneLight(0.8)), [0.2], atol=1e-3)


def test_corners_are_at_their_distance_from_the_box():
    np.testing.assert_allclose(
        kept(ground([[2.3, 1.4, 0.0], [2.5, 0.0, 0.0]])), [1.0 - CONTACT * np.exp(-((0.5 / 0.45) ** 2))] * 2, atol=1e-3
    )


def test_only_what_lies_on_the_ground_near_the_box_is_darker():
    far, high, deep = [6.0, 0.0, 0.0], [0.0, 1.1, LAYER + 0.02], [0.0, 1.1, -LAYER - 0.02]
    on_it, just_above = [0.0, 1.1, 0.0], [0.0, 1.1, LAYER - 0.02]
    shares = kept(ground([far, high, deep, on_it, just_above]))
    np.testing.assert_array_equal(shares[:3], 1.0)
    np.testing.assert_allclose(shares[3:], 1.0 - CONTACT * np.exp(-((0.1 / 0.45) ** 2)), atol=1e-3)
    own = ground([far, high])
    assert shaded(own, [(POSE, Shade(CAR, FROM_LEFT))]) is own and shaded(own, []) is own


def test_the_sun_darkens_the_side_away_from_it():
    """At 0.7 m beside the box there is little contact shadow."""
    places = [[0.0, -1.7, 0.0], [0.0, 1.7, 0.0], [0.0, -2.5, 0.0], [2.7, 0.0, 0.0]]
    contact = 1.0 - CONTACT * np.exp(-((0.7 / 0.45) ** 2))
    np.testing.assert_allclose(
        kept(ground(places), FROM_LEFT), [contact * (1.0 - CAST), contact, 1.0, contact], atol=2e-3
    )


@pytest.mark.parametrize("turned", [30.0, 90.0, -90.0, 180.0])
def test_shadows_follow_the_sun_of_the_world_and_the_box_of_the_car(turned):
    """Places to the right of the car, as it stands."""
    turn = rigid(about_z(np.radians(turned)), np.zeros(3))
    places = np.array([[0.0, -1.6, 0.0], [0.0, 1.6, 0.0]]) @ turn[:3, :3].T
    light = replace(FROM_LEFT, azimuth_deg=90.0 + turned)
    shares = kept(ground(places), light, POSE @ turn)
    np.testing.assert_allclose(shares, kept(ground([[0.0, -1.6, 0.0], [0.0, 1.6, 0.0]]), FROM_LEFT), atol=1e-4)
    assert shares[0] < 0.6 < 0.9 < shares[1]


def test_a_low_sun_casts_a_long_shadow():
    """At 15 degrees of 0.9 of the box's height of 1.5 m, 3.7 times as long as it is high."""
    places = [[0.0, -1.0 - reach, 0.0] for reach in (3.0, 4.4, 6.0)]
    found = kept(ground(places), replace(FROM_LEFT, elevation_deg=15.0))
    np.testing.assert_allclose(found, [1.0 - CAST, 1.0 - CAST, 1.0], atol=1e-3)


def test_a_large_gaussian_across_the_edge_of_a_shadow_is_darkened_in_part():
    """Its shadow ends 1.5 m * 0.95 beside the box; one half of the five places where it is looked at lies in it."""
    places = [[0.0, -2.4, 0.0], [0.0, -2.0, 0.0]]
    small, large = (kept(ground(places, size), FROM_LEFT) for size in (0.01, 0.8))
    assert small[1] < 0.55 and small[0] > 0.97
    assert small[1] < large[1] < small[0] - 0.05


def test_shadows_of_several_objects_multiply():
    own = ground([[0.0, -1.5, 0.0]])
    beside = rigid(np.eye(3), np.array([20.0, -3.0, 0.75]))
    both = shaded(own, [(POSE, Shade(CAR, DULL)), (beside, Shade(CAR, DULL))])
    one = 1.0 - CONTACT * np.exp(-((0.5 / 0.45) ** 2))
    torch.testing.assert_close(rgb_of(both), float(one**2) * rgb_of(own), atol=1e-4, rtol=1e-4)


def test_on_a_slope_the_ground_is_that_of_the_box():
    """A road that rises by 10 %: 5 m ahead it is half a metre higher."""
    pitch = -np.arctan(0.1)
    turn = np.array([[np.cos(pitch), 0.0, np.sin(pitch)], [0.0, 1.0, 0.0], [-np.sin(pitch), 0.0, np.cos(pitch)]])
    on_slope = rigid(turn, np.array([20.0, 0.0, 0.0]) + 0.75 * turn[:, 2])
    long = Shade(np.array([12.0, 2.0, 1.5]), DULL)
    own = ground([[5.0, 1.1, 0.5], [5.0, 1.1, 0.0]])
    shares = (rgb_of(shaded(own, [(on_slope, long)])) / rgb_of(own))[:, 0]
    assert shares[0] < 0.85 and float(shares[1]) == 1.0


# ---- in images

VIEW = looking_at([20.0, 0.0, 0.0], [8.0, -4.0, 6.0], time=1.0, width=96, height=64)


@pytest.fixture(scope="module")
def road() -> SplatModel:
    """A grey road, a wall beside it, the actors of the street, and an asset to place."""
    x, y = np.meshgrid(np.arange(10.0, 32.0, 0.25), np.arange(-7.0, 7.1, 0.25))
    places = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    model = SplatModel([round_gaussians(places, 0.2, colors=(0.5, 0.5, 0.5)), street_actors()], None)
    return with_assets(model, {"car": painted_box()}).requires_grad_(False)


def placed(model: SplatModel, light: SceneLight | None) -> PlacedModel:
    shade = None if light is None else Shade(CAR, light)
    return PlacedModel(FixedModel(model), 1.0, [ActorPlacement("car", POSE, shade=shade)])


@pytest.mark.parametrize("light", [DULL, FROM_LEFT], ids=["dull", "sunny"])
def test_an_image_is_darker_beside_the_object_and_equal_elsewhere(light, road):
    plain, shadowed = placed(road, None), placed(road, light)
    before, after = plain.render(VIEW).image, shadowed.render(VIEW).image
    at, rays = VIEW.camera_to_world[:3, 3], VIEW.rays()
    at = at - rays * at[2] / rays[..., 2:]  # where they meet the road
    beside = (at[..., :2] - torch.tensor([20.0, 0.0])).abs() - torch.from_numpy(CAR[:2] / 2.0).float()
    distance, road_there = beside.clamp(min=0.0).norm(dim=-1), plain.objects_in(VIEW) < 0
    near, far = road_there & (distance < 0.4), road_there & (distance > 4.0)
    assert near.sum() > 20 and far.sum() > 500
    change = after - before
    assert change[near].mean() < -0.02 and change.max() < 1e-4
    assert torch.equal(after[far], before[far])
    right = road_there & (beside[..., 0] < -0.5) & (at[..., 1] < -1.6) & (at[..., 1] > -2.0)
    assert right.sum() > 5 and (float(change[right].mean()) < -0.15) == (light.sun is not None)


def test_depth_objects_and_opacity_are_those_without_shadow(road):
    plain, shadowed = placed(road, None), placed(road, FROM_LEFT)
    assert torch.equal(plain.surface_depth(VIEW), shadowed.surface_depth(VIEW))
    assert torch.equal(plain.objects_in(VIEW), shadowed.objects_in(VIEW))
    assert torch.equal(plain.render(VIEW).alpha, shadowed.render(VIEW).alpha)


def test_objects_are_not_darkened(road):
    """Neither the object itself nor another that stands in its shadow."""
    beside = rigid(np.eye(3), np.array([20.0, -2.2, 0.75]))
    shade = Shade(CAR, FROM_LEFT)
    sets = [
        PlacedModel(
            FixedModel(road), 1.0, [ActorPlacement("car", POSE, shade=own), ActorPlacement("car", beside)]
        ).sets_in(VIEW)
        for own in (None, shade)
    ]
    assert torch.equal(sets[1][1].sh0, sets[0][1].sh0) and torch.equal(sets[1][2].sh0, sets[0][2].sh0)
    assert not torch.equal(sets[1][0].sh0, sets[0][0].sh0)
    assert torch.equal(road.parts[0].params["sh0"], sets[0][0].sh0), "the model itself stays"


def test_as_recorded_nothing_has_a_shadow(road):
    shown = PlacedModel(FixedModel(road), 1.0).gaussians_in(VIEW)
    assert torch.equal(shown.sh0[: len(road.parts[0])], road.parts[0].params["sh0"])


# ---- the light of a scene


def test_the_sun_is_where_its_angles_say():
    np.testing.assert_allclose(direction(0.0, 0.0), [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(FROM_LEFT.sun, [0.0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)
    assert DULL.sun is None and SceneLight(0.1, 0.3, azimuth_deg=10.0).sun is None


def test_a_light_that_is_read_is_the_one_that_was_written(tmp_path):
    for light in (DULL, FROM_LEFT):
        write_light(tmp_path / "light.json", light, {})
        assert read_light(tmp_path / "light.json") == light
    (tmp_path / "light.json").write_text('{"contact": 0.1, "cast": "much", "azimuth_deg": 1, "elevation_deg": 2}')
    with pytest.raises(ResultError, match=r"light\.json: not the light of a scene"):
        read_light(tmp_path / "light.json")
    (tmp_path / "light.json").write_text('{"contact": null, "cast": 0.1, "azimuth_deg": 1}')
    with pytest.raises(ResultError, match="elevation_deg"):
        read_light(tmp_path / "light.json")


# ---- the brightness of the ground


def colored_ground(**changes: Any) -> SplatModel:
    """80 Gaussians of the ground about POSE in one colour, and others in red: farther, higher, or nearly transparent,
    and objects."""
    rng = np.random.default_rng(3)
    near = np.column_stack([20.0 + rng.uniform(-7.0, 7.0, (80, 1)), rng.uniform(-7.0, 7.0, (80, 1)), np.zeros(80)])
    around = near + np.array([40.0, 0.0, 0.0]), near + np.array([0.0, 0.0, 0.8]), near
    places, others = near[: changes.get("count", 80)], np.concatenate(around)
    colors = [(0.2, 0.3, 0.4)] * len(places) + [(1.0, 0.0, 0.0)] * len(others)
    opacities = [0.9] * (len(places) + 160) + [0.2] * 80
    return SplatModel([round_gaussians([*places, *others], 0.2, opacities, colors), street_actors()], None)


def test_the_colour_of_the_ground_is_the_median_of_what_lies_about_an_object():
    found = ground_color(colored_ground(), 0.0, POSE, 1.5)
    np.testing.assert_allclose(found, [0.2, 0.3, 0.4], atol=1e-5)
    turned = POSE @ rigid(about_z(2.0), np.zeros(3))
    np.testing.assert_allclose(ground_color(colored_ground(), 0.0, turned, 1.5), found, atol=1e-5)


def test_ground_of_few_gaussians_is_unknown():
    assert ground_color(colored_ground(count=50), 0.0, POSE, 1.5) is not None
    assert ground_color(colored_ground(count=49), 0.0, POSE, 1.5) is None
    assert ground_color(colored_ground(), 0.0, rigid(np.eye(3), np.array([20.0, 0.0, 5.0])), 1.5) is None
    assert ground_color(SplatModel([street_actors()], None), 0.0, POSE, 1.5) is None


def test_gains_make_the_ground_of_a_drive_that_of_another():
    recorded, here = np.array([0.5, 0.4, 0.4]), np.array([0.4, 0.4, 0.48])
    gains = matching_gains(recorded, here)
    np.testing.assert_allclose(gains * recorded, here)


def test_gains_are_limited_up_and_down():
    recorded = np.array([0.1, 0.9, 0.4])
    np.testing.assert_allclose(matching_gains(recorded, np.array([0.9, 0.1, 0.4])), [MAX_GAIN, 1.0 / MAX_GAIN, 1.0])


@pytest.mark.parametrize(
    ("recorded", "here"),
    [(None, [0.4] * 3), ([0.4] * 3, None), (None, None), ([0.4, 0.0, 0.4], [0.2] * 3), ([0.4] * 3, [0.2, -0.01, 0.2]),
     ([0.4] * 3, [0.4] * 3), ([0.40, 0.40, 0.40], [0.43, 0.40, 0.37])],
    ids=["not recorded", "not here", "neither", "black there", "black here", "alike", "nearly alike"],
)  # fmt: skip
def test_colours_stay_where_the_ground_is_unknown_or_alike(recorded, here):
    assert matching_gains(*(None if color is None else np.array(color) for color in (recorded, here))) is None


def test_one_channel_that_differs_is_matched():
    found = matching_gains(np.array([0.4, 0.4, 0.4]), np.array([0.4, 0.4, 0.45]))
    np.testing.assert_allclose(found, [1.0, 1.0, 1.125])
