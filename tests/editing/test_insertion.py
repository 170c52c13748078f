"""Assets that an edit inserts: they look as the actor that they were, where its steps place them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hand_made import about_z, actors_of, looking_at, round_gaussians, track_of
from helpers.hand_made_assets import CAR, RED, asset_of, painted_box, rgb_of, round_ones
from helpers.hand_made_street import AHEAD, DRIVERS, GONE, SPEED, TURNING, straight
from helpers.hand_made_traffic import some_gaussians
from helpers.samples import EVERYTHING, sampled_with
from helpers.scanned_street import scan_records, scanned_street
from helpers.walkers import walker
from pydantic import ValidationError
from torch import nn

from drivesplat.editing.actors import EditedModel, edited_model
from drivesplat.editing.assets.asset import NO_INSERTS, Asset, AssetGait, Inserts, write_asset
from drivesplat.editing.assets.inserted import mean_lidar_logits, part_of, with_assets
from drivesplat.editing.assets.library import digests_of, read_inserts
from drivesplat.editing.assets.stage import assets_of
from drivesplat.editing.placed_model import PlacedModel, placed_models
from drivesplat.editing.render_plan import image_render_plan
from drivesplat.editing.scan_folder import scan_render_plan
from drivesplat.errors import ConfigError, ResultError
from drivesplat.io.storage import sha256_file
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.scans import ScanView
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement
from drivesplat.rasterization.scans import RayGrid
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.scene.light import OVERCAST, SceneLight, write_light
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.asset_references import asset_names, files_of_asset
from drivesplat.settings.edit import Edit, Insert, Step
from drivesplat.settings.export import DriveJob, ScanFolderJob
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.trajectories.edited_actors import EditedActor

EVERY_IMAGE = HoldoutSettings(every_nth=0, last_block=0)
IT = "0002/car"
"""The name of an asset in steps."""


def an_edit(*steps: dict[str, Any]) -> Edit:
    return Edit.model_validate({"steps": steps})


def insert(**fields: Any) -> dict[str, Any]:
    return {"insert": {"asset": IT, "as": "new", **fields}}


# ---- an asset in the place of its actor


def asset_in(model: SplatModel, scene: Scene, track: str = AHEAD) -> Asset:
    found = assets_of(model, scene, EVERY_IMAGE, "street", {}, {})
    return next(asset for asset in found if asset.source["track"] == track)


@pytest.mark.parametrize("turned", [0.0, 90.0, 200.0])
def test_an_asset_looks_as_its_actor_does_from_the_side_to_which_it_is_turned(turned, model, scene):
    """Gaussians of other lengths in each direction, and colours that depend on it."""
    asset = asset_in(model, scene)
    assert asset.gaussians.sh_degree == 1 and asset.gaussians.shN.abs().mean() > 0.1
    pose = straight(0.0) @ rigid(about_z(np.radians(turned)), np.zeros(3))
    view, whole = looking_at(pose[:3, 3], [2.0, -1.0, 2.0]), with_assets(model, {IT: asset})
    images = [
        PlacedModel(FixedModel(whole), 0.0, [ActorPlacement(name, pose, 1.2)] if name else []).render(view).image
        for name in (AHEAD, IT, None)
    ]
    torch.testing.assert_close(images[1], images[0], atol=2e-4, rtol=0.0)
    assert (images[0] - images[2]).abs().max() > 0.2
    elsewhere = PlacedModel(
        FixedModel(whole), 0.0, [ActorPlacement(IT, straight(0.0) @ rigid(about_z(1.0), np.zeros(3)), 1.2)]
    )
    assert (elsewhere.render(view).image - images[0]).abs().max() > 0.05


def test_an_asset_shows_nothing_until_it_is_placed(model, scene):
    whole = with_assets(model, {IT: asset_in(model, scene)})
    assert len(whole) == len(model) + 30 and len(whole.parts) == len(model.parts) + 1
    view = looking_at(straight(1.0)[:3, 3], [2.0, -1.0, 2.0], time=1.0)
    assert torch.equal(PlacedModel(FixedModel(whole), 1.0).render(view).image, model.render(view).image)
    for placements in ([], [ActorPlacement(TURNING)]):
        images = [PlacedModel(FixedModel(own), 1.0, placements).render(view).image for own in (whole, model)]
        assert torch.equal(*images)
    assert with_assets(model, {}) is model


def beams(place: tuple[float, float, float], toward: np.ndarray) -> ScanView:
    """Rays from a place around the direction to another, which it does not turn to."""
    ahead = toward - np.array(place)
    middle = float(np.arctan2(ahead[1], ahead[0])), float(np.arctan2(ahead[2], np.hypot(*ahead[:2])))
    azimuths, elevations = (torch.linspace(-0.2, 0.2, 15) + at for at in middle)
    around, up = torch.meshgrid(azimuths, elevations, indexing="xy")
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor(place)
    return ScanView(
        pose, RayGrid(around, up, torch.zeros_like(around)), torch.zeros(3), torch.zeros(3), 0.0, (5e-3,) * 2
    )


def car_with_echoes(scene: Scene) -> SplatModel:
    """One that returns more in some directions, before a wall with other echoes."""
    actors = actors_of(track_of(DRIVERS[AHEAD].motion, AHEAD, CAR), count=60, lidar_logits=(0.0, 2.0), seed=3)
    wall = round_gaussians([[60.0, y, 1.0] for y in np.arange(-8.0, 8.0, 0.4)], 0.4)
    logits = torch.zeros(len(wall), 4, 2)
    logits[:, 0] = torch.tensor([-3.0, 1.0])
    wall.params["lidar_logits"] = nn.Parameter(logits)
    with torch.no_grad():
        for correction in actors.shared.values():
            correction.zero_()
    return SplatModel([wall, actors], None).requires_grad_(False)


def test_a_lidar_measures_of_an_asset_what_it_measures_of_its_actor(scene):
    model = car_with_echoes(scene)
    asset = asset_in(model, scene)
    assert asset.gaussians.lidar_logits[:, 1:].abs().mean() > 0.1
    whole, pose = with_assets(model, {IT: asset}), straight(0.0) @ rigid(about_z(np.pi / 2.0), np.zeros(3))
    view = beams((1.0, -2.0, 2.0), pose[:3, 3])
    scans = [PlacedModel(FixedModel(whole), 0.0, [ActorPlacement(name, pose)]).scan(view) for name in (AHEAD, IT)]
    for name in ("range", "intensity", "returned", "alpha"):
        torch.testing.assert_close(getattr(scans[1], name), getattr(scans[0], name), atol=1e-4, rtol=1e-4)
    assert (scans[0].range[scans[0].alpha > 0.5] < 15.0).sum() > 20
    plain = replace(asset, gaussians=replace(asset.gaussians, lidar_logits=None))
    mean = PlacedModel(FixedModel(with_assets(model, {IT: plain})), 0.0, [ActorPlacement(IT, pose)]).scan(view)
    torch.testing.assert_close(mean.range, scans[0].range, atol=1e-4, rtol=1e-4)
    assert (mean.intensity - scans[0].intensity).abs().max() > 0.02


def test_an_asset_without_echoes_gets_the_mean_ones_of_the_objects(scene):
    model = car_with_echoes(scene)
    of_cars = model.parts[1].params["lidar_logits"][:, 0].mean(dim=0)
    plain = asset_of(some_gaussians(7, 0, seed=1))
    part = with_assets(model, {IT: plain}).parts[2]
    torch.testing.assert_close(part.params["lidar_logits"][:, 0], of_cars.expand(7, 2))
    assert not part.params["lidar_logits"][:, 1:].any()
    torch.testing.assert_close(mean_lidar_logits(SplatModel([model.parts[0]], None))[0], torch.tensor([-3.0, 1.0]))


def test_a_model_without_lidar_stays_so(model, scene):
    asset = asset_in(car_with_echoes(scene), scene)
    assert mean_lidar_logits(model) is None
    whole = with_assets(model, {IT: asset})
    assert all("lidar_logits" not in part.params for part in whole.parts)
    with pytest.raises(ResultError, match="trained without LiDAR"):
        PlacedModel(FixedModel(whole), 0.0, [ActorPlacement(IT, np.eye(4))]).scan(beams((5.0, 0.0, 0.0), np.zeros(3)))


def test_the_limbs_of_an_asset_follow_the_distance_that_it_walks():
    part, pose = walker(), np.eye(4)
    with torch.no_grad():
        part.shared["stride"] += 0.3
    (source,), settings = part.ids, part.settings
    p = part.params
    gaussians = Gaussians(
        p["means"].detach(), torch.nn.functional.normalize(p["quats"].detach(), dim=-1), p["scales"].detach().exp(),
        torch.sigmoid(p["opacities"].detach()), p["sh0"].detach()[:, 0], p["shN"].detach()[:, 0],
    )  # fmt: skip
    cycle = float(part.cycle_lengths.detach()[0])
    gait = AssetGait(cycle, settings.gait, settings.lattice, part.shared["lattice"][0].detach())
    person = {"object_class": ObjectClass.PEDESTRIAN, "size": np.array([0.8, 0.6, 1.8])}
    copy = part_of(IT, asset_of(gaussians, gait=gait, **person), None)
    shapes = []
    for walked in (0.0, 0.3, 1.1, 0.3 + cycle):
        beside = walked - 0.01, walked + 0.01
        own, found = (
            sampled_with(
                of, 1.0,
                [ActorPlacement(name, pose, around=(pose, pose), walked=walked, walked_around=beside, phase=0.2)],
                EVERYTHING,
            )
            for of, name in ((part, source), (copy, IT))
        )  # fmt: skip
        for name in ("means", "scales", "opacities", "sh0"):
            torch.testing.assert_close(found.tensors[name], own.tensors[name].detach(), atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(found.velocities, own.velocities, atol=2e-2, rtol=1e-2)
        shapes.append(found.means.detach())
    assert (shapes[1] - shapes[0]).abs().max() > 0.05 and found.velocities.abs().max() > 0.1
    torch.testing.assert_close(shapes[3], shapes[1], atol=1e-4, rtol=0.0)


# ---- the step `insert`


SMALL = np.array([2.0, 1.0, 1.2])


@pytest.fixture(scope="module")
def inserts() -> Inserts:
    """A small car, and a person who is not in the drive."""
    person = {"object_class": ObjectClass.PEDESTRIAN, "category": "human", "size": np.array([0.8, 0.6, 1.8])}
    return Inserts({
        IT: asset_of(round_ones([[0.0, 0.0, 0.0], [0.5, 0.2, 0.1]], RED, 0.3), size=SMALL, seen=np.array([3.0])),
        "0002/person": asset_of(round_ones([[0.0, 0.0, 0.0]], RED, 0.3), **person),
    })  # fmt: skip


def edited(model: SplatModel, scene: Scene, inserts: Inserts, *steps: dict[str, Any]) -> EditedModel:
    return edited_model(model, scene, "CAM_FRONT", an_edit(*steps), "here", inserts)


def the_new(found: EditedModel) -> EditedActor:
    return next(actor for actor in found.actors if actor.id == "new")


def ego_of(scene: Scene) -> np.ndarray:
    return min((f for f in scene.frames if f.camera == "CAM_FRONT"), key=lambda frame: frame.timestamp).ego_to_world


def at(actor: EditedActor, *seconds: float) -> np.ndarray:
    return actor.poses(np.array(seconds))


def test_an_object_stands_beside_the_ego_vehicle_where_it_began_from_its_start_on(model, scene, inserts):
    new = the_new(edited(model, scene, inserts, insert(at=[20.0, 3.0], start=1.5, yaw=30.0)))
    expected = ego_of(scene) @ rigid(about_z(np.radians(30.0)), np.array([20.0, 3.0, 0.6]))
    np.testing.assert_allclose(at(new, 1.5, 4.0), [expected, expected], atol=1e-6)
    assert new.present(np.array([1.3, 1.5, 4.0, 100.0])).tolist() == [False, True, True, True]
    assert (new.object_class, new.category, new.source, new.scale) == (ObjectClass.CAR, "vehicle.car", IT, 1.0)
    np.testing.assert_array_equal(new.size, SMALL)
    np.testing.assert_array_equal(new.seen, [3.0])


def test_an_object_drives_through_the_points_of_its_path(model, scene, inserts):
    path = [[1.0, 10.0, 3.0], [3.0, 20.0, 3.0]]
    new = the_new(edited(model, scene, inserts, insert(path=path, phase=0.25)))
    expected = [ego_of(scene) @ rigid(np.eye(3), np.array([x, 3.0, 0.6])) for x in (10.0, 15.0, 20.0)]
    np.testing.assert_allclose(at(new, 1.0, 2.0, 3.0), expected, atol=1e-3)
    assert new.present(np.array([0.8, 1.0, 3.0, 3.2])).tolist() == [False, True, True, False]
    assert new.phase == 0.25


def on_the_ground(pose: np.ndarray) -> np.ndarray:
    """A pose of AHEAD as that of a box of 1.2 m."""
    return pose + np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, -0.15], [0, 0, 0, 0]])


FOLLOWING = {
    "behind": ({}, lambda t: straight(t)),
    "beside": ({"lateral": -3.0}, lambda t: straight(t) @ rigid(np.eye(3), np.array([0.0, -3.0, 0.0]))),
    "further": ({"longitudinal": 6.0}, lambda t: straight(t + 1.0)),
    "turned": ({"yaw": 90.0}, lambda t: straight(t) @ rigid(about_z(np.pi / 2.0), np.zeros(3))),
    "slower": ({"speed": 3.0}, lambda t: straight(0.5 * t)),
    "slower and beside": ({"speed": 3.0, "lateral": 2.0, "longitudinal": 6.0},
                          lambda t: straight(0.5 * t + 1.0) @ rigid(np.eye(3), np.array([0.0, 2.0, 0.0]))),
}  # fmt: skip


@pytest.mark.parametrize(("fields", "pose"), FOLLOWING.values(), ids=FOLLOWING)
def test_an_object_follows_the_path_of_a_track(fields, pose, model, scene, inserts):
    new = the_new(edited(model, scene, inserts, insert(follow="6e5c", **fields)))
    np.testing.assert_allclose(at(new, 0.0, 1.3, 3.0), [on_the_ground(pose(t)) for t in (0.0, 1.3, 3.0)], atol=1e-3)
    assert new.present(np.array([0.0, 4.5])).all()


@pytest.mark.parametrize("speed", [None, 3.0])
def test_an_object_that_follows_appears_at_its_start_where_the_track_begins(speed, model, scene, inserts):
    new = the_new(edited(model, scene, inserts, insert(follow=AHEAD, start=2.0, speed=speed)))
    begin = DRIVERS[AHEAD].motion.span[0]
    expected = [on_the_ground(straight(begin + t * (speed or SPEED) / SPEED)) for t in (0.0, 1.0, 2.0)]
    np.testing.assert_allclose(at(new, 2.0, 3.0, 4.0), expected, atol=1e-3)
    assert new.present(np.array([0.0, 1.0, 1.95, 2.05, 4.0])).tolist() == [False, False, False, True, True]


def test_an_object_follows_a_track_as_steps_before_changed_it(model, scene, inserts):
    steps = {"shift": {"track": AHEAD, "lateral": 2.0}}, {"remove": {"track": AHEAD}}
    found = edited(model, scene, inserts, *steps, insert(follow=AHEAD))
    assert [actor.id for actor in found.actors] == [TURNING, GONE, "new"]
    expected = on_the_ground(straight(1.0)) @ rigid(np.eye(3), np.array([0.0, 2.0, 0.0]))
    np.testing.assert_allclose(at(the_new(found), 1.0)[0], expected, atol=1e-3)


def test_an_object_that_follows_a_truck_with_a_gap_is_absent_in_it(model, scene, inserts):
    times = np.array([1.0, 2.2, 4.0])
    found = edited(model, scene, inserts, insert(follow=GONE))
    truck = next(actor for actor in found.actors if actor.id == GONE)
    assert the_new(found).present(times).tolist() == truck.present(times).tolist() == [True, False, True]


def placed_at(found: EditedModel, second: float) -> PlacedModel:
    (placed,) = placed_models(found.model, found.actors, np.array([second]))
    return placed


def own_rows(found: EditedModel, second: float, *names: str) -> list[Gaussians]:
    """The Gaussians of objects at a second."""
    placed = placed_at(found, second)
    shown = [actor.id for actor in found.actors if actor.present(np.array([second]))[0]]
    gaussians = placed.gaussians_in(looking_at([1.0, 0.0, 0.0], [0.0, 0.0, 0.0], time=second))
    return [gaussians[gaussians.placement == shown.index(name)] for name in names]


def test_only_the_part_of_the_asset_comes_to_the_model_and_the_others_stay(model, scene, inserts):
    found = edited(model, scene, inserts, insert(at=[20.0, 3.0]))
    assert [actor.id for actor in found.recorded] == [AHEAD, TURNING, GONE]
    assert [actor.id for actor in found.actors] == [AHEAD, TURNING, GONE, "new"]
    assert not any(actor.edited for actor in found.actors[:3])
    assert len(found.model) == len(model) + 2, "the person is not inserted"
    (own,) = own_rows(found, 1.0, "new")
    place = (ego_of(scene) @ np.array([20.0, 3.0, 0.6, 1.0]))[:3]
    np.testing.assert_allclose(own.means, place + np.array([[0.0, 0.0, 0.0], [0.5, 0.2, 0.1]]), atol=1e-4)


def test_later_steps_change_an_inserted_object(model, scene, inserts):
    steps = [
        insert(at=[20.0, 3.0]),
        {"shift": {"track": "new", "lateral": 2.0}},
        {"rescale": {"track": "new", "factor": 2.0}},
        {"recolour": {"track": "new", "colour": [0.0, 0.0, 1.0]}},
        {"duplicate": {"track": "new", "as": "twin", "lateral": -6.0}},
        {"recolour": {"track": "twin", "value": 0.5}},
    ]
    found = edited(model, scene, inserts, *steps)
    first, second = own_rows(found, 1.0, "new", "twin")
    ego = ego_of(scene)
    for own, left in ((first, 5.0), (second, -1.0)):
        place = (ego @ np.array([20.0, left, 1.2, 1.0]))[:3]
        np.testing.assert_allclose(own.means, place + 2.0 * np.array([[0.0, 0.0, 0.0], [0.5, 0.2, 0.1]]), atol=1e-3)
        assert rgb_of(own)[:, :2].abs().max() < 1e-4, "blue"
    torch.testing.assert_close(rgb_of(second), 0.5 * rgb_of(first), atol=1e-5, rtol=0.0)
    np.testing.assert_allclose(the_new(found).size, 2.0 * SMALL)
    gone = edited(model, scene, inserts, *steps[:1], {"remove": {"track": "new"}})
    assert len(gone.actors) == 3 and gone.model is model


def test_one_asset_can_be_inserted_twice(model, scene, inserts):
    found = edited(model, scene, inserts, insert(at=[20.0, 3.0]), insert(at=[20.0, -3.0], **{"as": "other"}))
    assert len(found.model) == len(model) + 2
    first, second = own_rows(found, 1.0, "new", "other")
    np.testing.assert_allclose((first.means - second.means)[:, 1], [6.0, 6.0], atol=1e-3)


def test_an_object_comes_into_a_model_without_actors(scene, inserts):
    bare = SplatModel([round_gaussians([[30.0, 0.0, 0.0]])], None)
    found = edited(bare, scene, inserts, insert(at=[20.0, 3.0]))
    assert [actor.id for actor in found.actors] == ["new"] and found.recorded == []
    with pytest.raises(ConfigError, match="has no actors"):
        edited(bare, scene, NO_INSERTS, {"remove": {"track": AHEAD}})


def test_colours_are_as_bright_as_the_ground_is_here(scene):
    """Grey ground of 0.4 around the place; where the asset was recorded it was of 0.5, 0.4 and 0.25."""
    places = [[x, y, 0.0] for x in np.arange(10.0, 30.0, 1.0) for y in np.arange(-5.0, 6.0, 1.0)]
    model = SplatModel([round_gaussians(places, 0.5, colors=(0.4, 0.4, 0.4))], None).requires_grad_(False)
    asset = asset_of(round_ones([[0.0, 0.0, 0.0]], (0.5, 0.5, 0.5)), ground=np.array([0.5, 0.4, 0.25]), size=SMALL)
    matched, plain = (
        edited(model, scene, Inserts({IT: asset}), insert(at=[16.0, 0.0], match_exposure=match))
        for match in (True, False)
    )
    (found,), (own,) = own_rows(matched, 1.0, "new"), own_rows(plain, 1.0, "new")
    torch.testing.assert_close(rgb_of(own), torch.tensor([[0.5, 0.5, 0.5]]), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(rgb_of(found), torch.tensor([[0.4, 0.5, 0.8]]), atol=1e-4, rtol=0.0)
    unknown = replace(asset, ground=None)
    assert the_new(edited(model, scene, Inserts({IT: unknown}), insert(at=[16.0, 0.0]))).color_matrix is None


def test_an_object_casts_the_shadow_of_its_size_in_the_light_of_the_scene(model, scene, inserts):
    light = SceneLight(0.2, 0.4, 90.0, 45.0)
    steps = [insert(at=[20.0, 3.0]), {"rescale": {"track": "new", "factor": 2.0}}]
    actor = the_new(edited(model, scene, replace(inserts, light=light), *steps))
    assert actor.shade.light == light
    np.testing.assert_allclose(actor.shade.size, 2.0 * SMALL)
    assert the_new(edited(model, scene, inserts, insert(at=[20.0, 3.0], shadow=False))).shade is None


# ---- labels


def test_labels_of_images_have_the_inserted_object_with_its_class_and_size(model, scene):
    box = Inserts({IT: painted_box(category="vehicle.rare", object_class=ObjectClass.TRUCK)})
    job = DriveJob(
        eval_camera="CAM_FRONT", cameras=("CAM_FRONT",), images=ImageSettings(width=64), holdout=EVERY_IMAGE,
        edit=an_edit(insert(at=[14.0, 0.0], start=1.0)),
    )  # fmt: skip
    plan = image_render_plan(scene, model, job, Path("here"), "it", box)
    for tracks in (plan.scene.tracks, plan.tracks):
        (track,) = (one for one in tracks if one.id == "new")
        assert (track.object_class, track.category) == (ObjectClass.TRUCK, "vehicle.rare")
        np.testing.assert_array_equal(track.size, CAR)
        assert scene.seconds(track.timestamps[0]) >= 0.9
        expected = ego_of(scene) @ rigid(np.eye(3), np.array([14.0, 0.0, 0.75]))
        np.testing.assert_allclose(track.object_to_world, np.tile(expected, (len(track.timestamps), 1, 1)), atol=1e-6)
    views = [view for view in plan.views(torch.device("cpu")) if view.time in (0.5, 1.5)]
    assert len(views) == 2
    seen = [{item.id: item for item in plan.objects.seen_in(view)} for view in views]
    assert "new" not in seen[0]
    assert seen[1]["new"].visible > 0.5
    left, top, right, bottom = seen[1]["new"].corners
    assert 0.0 <= left < 32.0 < right <= 64.0 and bottom - top > 3.0
    assert plan.objects.shown_by(set())["new"] == "own"


def test_scans_meet_the_inserted_object_and_name_it(scene):
    """Its own logits are the mean ones of the vehicles there."""
    records = scan_records(scene)
    job = ScanFolderJob(eval_camera="CAM_FRONT", formats=("npz",), edit=an_edit(insert(at=[16.0, -2.0])))
    plan = scan_render_plan(scene, scanned_street(scene), records.scans[2:3], job, "here", Inserts({IT: painted_box()}))
    objects = plan.objects()
    number = [item["id"] for item in objects].index("new")
    assert objects[number] == {
        "id": "new", "track": IT, "category": "vehicle.car", "class": "car", "size": [4.0, 2.0, 1.5]
    }  # fmt: skip
    (found,) = plan.simulated((3e-4, 3e-4))
    met = found.places()[0][found.objects[found.returned] == number]
    assert len(met) > 5
    ahead = (met - ego_of(scene)[:3, 3]) @ ego_of(scene)[:3, :3]
    assert (np.abs(ahead - [16.0, -2.0, 0.75]) < CAR / 2.0 + 0.4).all(axis=1).mean() > 0.9


# ---- refusals

PERSON = "0002/person"
TOO_FAST = "it moves at up to 15.0 m/s, and the limit of the class 'pedestrian' is 8 m/s: give its points more time"
REFUSED = {
    "a taken name": (insert(at=[9, 0], **{"as": AHEAD}),
                     f"the name '{AHEAD}' in 'as' is already used; names in use: {AHEAD}, {TURNING}, {GONE}"),
    "an unread asset": (insert(at=[9, 0], asset="0003/car"),
                        "the asset '0003/car' was not read; here are: 0002/car, 0002/person"),
    "an unknown track": (insert(follow="ff"), "no editable track has an id starting with 'ff'"),
    "two tracks": (insert(follow="6e"), "2 tracks have ids starting with '6e'"),
    "a fast person": (insert(path=[[0, 0, 0], [2, 30, 0]], asset=PERSON), TOO_FAST),
    "a fast follower": (insert(follow=AHEAD, speed=15.0, asset=PERSON), TOO_FAST),
}  # fmt: skip


@pytest.mark.parametrize(("step", "said"), REFUSED.values(), ids=REFUSED)
def test_steps_that_cannot_be_are_refused_in_a_sentence(step, said, model, scene, inserts):
    with pytest.raises(ConfigError) as refused:
        edited(model, scene, inserts, {"ego": {"lateral": 1.0}}, step)
    assert str(refused.value).startswith(f"here, step 2 (insert): {said}") and "\n" not in str(refused.value)


def test_the_id_of_a_track_that_cannot_be_edited_is_taken(model, scene, inserts):
    other = next(track.id for track in scene.tracks if track.id not in DRIVERS)
    with pytest.raises(ConfigError, match="in 'as' is the id of another track; choose another name"):
        edited(model, scene, inserts, insert(at=[9, 0], **{"as": other}))
    with pytest.raises(ConfigError, match=r"step 2 \(insert\): the name 'new' in 'as' is already used"):
        edited(model, scene, inserts, insert(at=[9, 0]), insert(at=[9, 5]))


def test_people_run_and_cars_drive_as_fast_as_they_can(model, scene, inserts):
    for fields in ({"asset": PERSON, "path": [[0, 0, 0], [2, 15, 0]]}, {"path": [[0, 0, 0], [1, 60, 0]]}):
        assert the_new(edited(model, scene, inserts, insert(**fields))).id == "new"


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, "give one of 'path', 'at' and 'follow'"),
        ({"at": [9, 0], "follow": AHEAD}, "give one of 'path', 'at' and 'follow'"),
        ({"at": [9, 0], "path": [[0, 9, 0]]}, "give one of 'path', 'at' and 'follow'"),
        ({"at": [9, 0], "speed": 3.0}, "'speed' is for an object with 'follow'"),
        ({"path": [[0, 9, 0]], "lateral": 3.0}, "'lateral' is for an object with 'follow'"),
        ({"at": [9, 0], "longitudinal": 3.0}, "'longitudinal' is for an object with 'follow'"),
        ({"path": [[0, 9, 0]], "start": 3.0}, "'path' has the seconds of its points: leave out 'start'"),
        ({"path": []}, "give at least one point in 'path'"),
        ({"path": [[1, 9, 0], [1, 12, 0]]}, "the seconds of 'path' must increase from point to point"),
        ({"follow": AHEAD, "speed": 0.0}, "greater than 0"),
    ],
)
def test_fields_that_contradict_each_other_are_refused(fields, said):
    with pytest.raises(ValidationError) as refused:
        Insert.model_validate(insert(**fields)["insert"])
    (error,) = refused.value.errors()
    assert said in error["msg"]


def test_a_step_says_what_it_inserts_and_when():
    step = Step.model_validate(insert(at=[20.0, 3.0], start=1.5))
    assert step.begins == 1.5 and step.insert.waypoints == ((1.5, 20.0, 3.0),)
    assert step.in_words == "insert, asset 0002/car, as new, at [20 3], start 1.5"
    assert Step.model_validate(insert(path=[[2.0, 9, 0], [3.0, 12, 0]])).begins == 2.0
    assert Step.model_validate(insert(follow=AHEAD)).begins == 0.0
    assert Step.model_validate(step.model_dump(mode="json")) == step


# ---- where assets are read from


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """Assets of a method of one scene, and of another method of a second scene."""
    results = tmp_path_factory.mktemp("results")
    for scene, method, tracks in (("0001", "street", ("6e5c11", "6e7d22")), ("0002", "lidar", ("91ab33",))):
        folder, records = results / scene / method / "assets", []
        for number, track in enumerate(tracks):
            name = f"{scene}/{method}/{track}"
            write_asset(folder / f"car {track}", asset_of(some_gaussians(5 + number, 0, seed=1), name=name))
            records.append({"track": track, "folder": f"car {track}"})
        (folder / "assets.json").write_text(json.dumps({"assets": records}))
    return results


def read(results: Path, *names: str, method: str = "street") -> Inserts:
    """What a step for each name inserts into scene 0001."""
    steps = [insert(at=[9, 0], asset=name, **{"as": f"new{i}"}) for i, name in enumerate(names)]
    return read_inserts(an_edit(*steps), results / "0001" / method)


@pytest.mark.parametrize(
    ("name", "found"),
    [("0001/6e5c11", "0001/street/6e5c11"), ("0001/6e7", "0001/street/6e7d22"), ("0002/lidar/9", "0002/lidar/91ab33")],
)
def test_assets_of_results_are_named_by_scene_perhaps_method_and_the_beginning_of_a_track(name, found, results):
    inserts = read(results, name)
    assert {key: asset.name for key, asset in inserts.assets.items()} == {name: found}
    assert inserts.light == OVERCAST


def test_a_path_names_the_folder_of_an_asset(results, monkeypatch):
    monkeypatch.chdir(results / "0002")
    monkeypatch.setenv("HOME", str(results))
    folder = "lidar/assets/car 91ab33"
    names = f"./{folder}", f"../0002/{folder}", f"~/0002/{folder}", str(results / "0002" / folder)
    inserts = read(results, *names)
    assert {asset.name for asset in inserts.assets.values()} == {"0002/lidar/91ab33"} and (*inserts.assets,) == names
    with pytest.raises(ResultError, match=r"is not an asset: it has no asset\.json"):
        read(results, "./lidar/assets")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("0001/6e", "assets.json: 2 assets have an id starting with '6e'; there are: 6e5c11, 6e7d22"),
        ("0001/ff", "assets.json: no asset has an id starting with 'ff'; there are: 6e5c11, 6e7d22"),
        ("0002/91ab33", "0002/street/assets/assets.json"),
    ],
)
def test_assets_that_are_not_there_or_not_unique_are_refused(name, said, results):
    with pytest.raises(ResultError) as refused:
        read(results, name)
    assert said in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["car", "0001//6e5c", "0001/a/b/c", "0001/"])
def test_names_that_are_neither_are_refused(name, results):
    with pytest.raises(ConfigError) as refused:
        read(results, name)
    assert str(refused.value).startswith(f"asset {name!r} is neither {{scene}}/{{track}} nor")


def test_the_light_of_the_scene_is_read_where_it_is_known(results, tmp_path):
    light = SceneLight(0.15, 0.4, 120.0, 35.0)
    scene = tmp_path / "0001"
    scene.symlink_to(results / "0001")
    write_light(results / "0001" / "light.json", light, {})
    try:
        assert read(tmp_path, "0001/6e5c11").light == light
        (results / "0001" / "light.json").write_text("{}")
        with pytest.raises(ResultError, match=r"light\.json"):
            read(tmp_path, "0001/6e5c11")
    finally:
        (results / "0001" / "light.json").unlink()


def test_the_digests_are_those_of_the_files_that_were_read(results):
    inserts = read(results, "0001/6e5c11", "0001/6e7d22")
    file = results / "0001/street/assets/car 6e5c11/asset.ply"
    found = digests_of(inserts)
    assert {*found} == {"asset 0001/6e5c11", "asset 0001/6e7d22", "light"}
    assert found["asset 0001/6e5c11"] == sha256_file(file) != found["asset 0001/6e7d22"]
    assert digests_of(replace(inserts, light=SceneLight(0.3)))["light"] != found["light"]
    assert digests_of(NO_INSERTS) == {}


def test_edits_that_insert_nothing_need_no_files(tmp_path):
    assert read_inserts(None, tmp_path / "0001/street") is NO_INSERTS
    assert read_inserts(an_edit({"remove": {"track": AHEAD}}), tmp_path / "0001/street") is NO_INSERTS


def test_a_rule_needs_the_index_of_results_or_the_files_of_a_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    results = Path("results")
    assert files_of_asset("0001/6e", results, "street") == [Path("results/0001/street/assets/assets.json")]
    assert files_of_asset("0001/lidar/6e", results, "street") == [Path("results/0001/lidar/assets/assets.json")]
    assert files_of_asset("~/car", results, "street") == [
        Path("/home/me/car/asset.json"),
        Path("/home/me/car/asset.ply"),
    ]
    twice = an_edit(insert(at=[9, 0]), {"remove": {"track": "x"}}, insert(at=[9, 0]), insert(at=[1, 0], asset="./car"))
    assert asset_names(twice) == [IT, "./car"]
