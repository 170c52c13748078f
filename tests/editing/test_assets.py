"""Actors as assets: what their files hold, which files are refused, and which Gaussians of a model an asset has."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hand_made import round_gaussians
from helpers.hand_made_assets import CAR, asset_of, round_ones
from helpers.hand_made_street import AHEAD, GONE, TURNING, checkpoint_of, street_actors, street_model
from helpers.hand_made_traffic import placed, some_gaussians
from helpers.walkers import walker, walking
from PIL import Image

from drivesplat.editing.assets import asset as asset_module
from drivesplat.editing.assets.asset import LIDAR, Asset, AssetGait, read_asset, write_asset
from drivesplat.editing.assets.stage import assets_of, write_assets
from drivesplat.editing.assets.turntable import VIEWS
from drivesplat.errors import ResultError
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.splat_ply import write_splat_ply
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.asset_references import PLY, RECORD
from drivesplat.settings.deformable import GaitSettings, LatticeSettings
from drivesplat.settings.export import AssetsJob
from drivesplat.settings.images import HoldoutSettings
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.motion import Motion
from drivesplat.trajectories.seen_sides import TimedCameras

EVERY_IMAGE = HoldoutSettings(every_nth=0, last_block=0)
PERSON = np.array([0.8, 0.6, 1.8])
NODES = (2, 3, 4)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def a_person() -> Asset:
    """One of whom everything is known."""
    gaussians = some_gaussians(25, 1, seed=4)
    quats = torch.nn.functional.normalize(gaussians.quats, dim=-1)
    nodes = 0.1 * random(4, *NODES, 6, seed=1)
    return asset_of(
        replace(gaussians, quats=quats, lidar_logits=random(25, 4, 2, seed=2)),
        object_class=ObjectClass.PEDESTRIAN,
        category="human.pedestrian.adult",
        size=PERSON,
        invented=torch.arange(25) % 3 == 0,
        gait=AssetGait(1.37, GaitSettings(harmonics=2), LatticeSettings(nodes=NODES), nodes),
        seen=np.array([-3.0, 0.25, 1.5]),
        source={"dataset": "tiny", "scene": "0001", "method": "street", "track": "it"},
        quality={"psnr": 21.5, "images": 3},
        ground=np.array([0.25, 0.3, 0.35]),
        provenance={"stage": "actor_assets"},
    )


def assert_same(found: Gaussians, expected: Gaussians) -> None:
    assert found.tensors.keys() == expected.tensors.keys()
    for name, values in expected.tensors.items():
        torch.testing.assert_close(found.tensors[name], values, atol=1e-6, rtol=1e-5)


# ---- files


def test_an_asset_that_is_read_is_the_one_that_was_written(tmp_path):
    written = a_person()
    write_asset(tmp_path / "it", written)
    found = read_asset(tmp_path / "it")
    assert_same(found.gaussians, written.gaussians)
    assert torch.equal(found.invented, written.invented)
    for name in ("name", "object_class", "category", "source", "quality", "provenance"):
        assert getattr(found, name) == getattr(written, name), name
    for name in ("size", "seen", "ground"):
        np.testing.assert_allclose(getattr(found, name), getattr(written, name), atol=1e-6)
    assert found.gait.cycle == pytest.approx(1.37)
    assert (found.gait.settings, found.gait.lattice) == (written.gait.settings, written.gait.lattice)
    torch.testing.assert_close(found.gait.nodes, written.gait.nodes, atol=1e-6, rtol=0.0)
    assert len(found.digest) == 64 and found.record() == read_asset(tmp_path / "it").record()


def test_a_car_without_lidar_gait_and_ground_is_read_so(tmp_path):
    write_asset(tmp_path, asset_of(some_gaussians(5, 0, seed=1)))
    found = read_asset(tmp_path)
    assert found.gaussians.lidar_logits is None and found.gait is None and found.ground is None
    assert not len(found.seen) and not found.invented.any()


def test_the_record_says_what_the_asset_is():
    """Its colour is that of its large and opaque Gaussians."""
    gaussians = round_ones([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.8, 0.2, 0.1], [0.0, 0.0, 1.0]])
    scales = torch.tensor([[0.3, 0.1, 0.1], [0.1, 0.1, 0.1]])
    record = asset_of(replace(gaussians, scales=scales), invented=torch.tensor([False, True])).record()
    names = ("schema", "class", "gaussians", "invented", "sh_degree", "lidar", "gait")
    assert {name: record[name] for name in names} == {
        "schema": 1, "class": "car", "gaussians": 2, "invented": 1, "sh_degree": 0, "lidar": None, "gait": None
    }  # fmt: skip
    np.testing.assert_allclose(record["mean_color"], [0.72, 0.18, 0.19], atol=1e-5)
    assert (record["frame"]["x"], record["frame"]["y"], record["frame"]["z"]) == ("forward", "left", "up")


def test_a_plain_splat_is_an_asset_of_which_all_was_seen_and_which_has_no_echoes(tmp_path):
    asset = a_person()
    write_asset(tmp_path, asset)
    plain = replace(asset.gaussians, lidar_logits=None)
    write_splat_ply(tmp_path / PLY, plain, {})
    found = read_asset(tmp_path)
    assert_same(found.gaussians, plain)
    assert found.invented.shape == (25,) and not found.invented.any()


def test_an_incomplete_set_of_lidar_columns_is_none(tmp_path):
    asset = a_person()
    write_asset(tmp_path, asset)
    write_splat_ply(tmp_path / PLY, asset.gaussians, {}, dict.fromkeys(LIDAR[:7], np.zeros(25, np.float32)))
    assert read_asset(tmp_path).gaussians.lidar_logits is None


# ---- refusals


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "person"
    write_asset(folder, a_person())
    return folder


@pytest.fixture
def folder(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "person"))


def refusal(folder: Path, file: Path) -> str:
    """What is said of an asset, after the name of the file at fault."""
    with pytest.raises(ResultError) as refused:
        read_asset(folder)
    said = str(refused.value)
    assert "\n" not in said and said.startswith(str(file))
    return said.removeprefix(str(file))


def with_gait(**changes: Any) -> Callable[[dict], Any]:
    return lambda record: {**record, "gait": {**record["gait"], **changes}}


RECORDS = {
    "of another version": (lambda r: {**r, "schema": 2}, "its schema is 2, not 1; make the asset again"),
    "a list": (lambda r: [r], "its schema is None, not 1"),
    "without frame": (lambda r: {k: v for k, v in r.items() if k != "frame"}, 'declare the frame {"x": "forward"'),
    "another frame": (lambda r: {**r, "frame": {**r["frame"], "z": "down"}}, "it does not declare the frame"),
    "a long person": (lambda r: {**r, "size": [5.0, 0.6, 1.8]},
                      "its box of 5 x 0.6 x 1.8 m does not fit its class 'pedestrian' (0.1 to 3 m)"),
    "a thin person": (lambda r: {**r, "size": [0.05, 0.6, 1.8]}, "does not fit its class 'pedestrian'"),
    "a huge car": (lambda r: {**r, "class": "car", "size": [31.0, 2.0, 1.5]}, "does not fit its class 'car'"),
    "two edges": (lambda r: {**r, "size": [0.8, 1.8]}, "its size [0.8, 1.8] is not three numbers"),
    "an edge that is no number": (lambda r: {**r, "size": [0.8, float("nan"), 1.8]}, "is not three numbers"),
    "no size": (lambda r: {k: v for k, v in r.items() if k != "size"}, "it lacks 'size'"),
    "an unknown class": (lambda r: {**r, "class": "dragon"}, "'dragon' is not a valid ObjectClass"),
    "ground of two colours": (lambda r: {**r, "ground_color": [0.2, 0.3]}, "its ground_color is not three numbers"),
    "fewer nodes": (lambda r: with_gait(nodes=r["gait"]["nodes"][:3])(r), "nodes of its gait do not fit its lattice"),
    "another lattice": (with_gait(lattice={"nodes": [2, 3, 5]}), "the nodes of its gait do not fit its lattice"),
    "nodes that are no numbers": (lambda r: with_gait(nodes=[[[[[[float("nan")] * 6] * 4] * 3] * 2]] * 4)(r),
                                  "the nodes of its gait do not fit its lattice"),
    "a cycle of 1 cm": (with_gait(cycle_m=0.01), "a cycle of its gait is 0.01 m long"),
    "a gait without cycle": (lambda r: {**r, "gait": {k: v for k, v in r["gait"].items() if k != "cycle_m"}},
                             "it lacks 'cycle_m'"),
    "a gait of unknown settings": (with_gait(gait={"legs": 4}), "legs: Extra inputs are not permitted"),
    "directions that are no numbers": (lambda r: {**r, "seen": [float("nan")]}, "contain NaN or Inf"),
    "an edge without end": (lambda r: {**r, "size": [10**400, 1, 1]}, "too large"),
}  # fmt: skip


@pytest.mark.parametrize(("changed", "said"), RECORDS.values(), ids=RECORDS)
def test_a_record_that_is_none_of_an_asset_is_refused(changed, said, folder):
    path = folder / RECORD
    path.write_text(json.dumps(changed(json.loads(path.read_text()))))
    refused = refusal(folder, path)
    assert refused.startswith(": not an asset: ") and said in refused


def test_a_person_of_3_m_and_a_bus_of_18_m_are_none_too_large(folder):
    path = folder / RECORD
    record = json.loads(path.read_text())
    for kind, size in (("pedestrian", [3.0, 0.6, 1.8]), ("bus", [18.0, 2.5, 3.2])):
        path.write_text(json.dumps({**record, "class": kind, "size": size}))
        np.testing.assert_array_equal(read_asset(folder).size, size)


def test_folders_without_the_files_of_an_asset_are_refused(folder):
    assert refusal(folder / "none", folder / "none") == " is not an asset: it has no asset.json"
    (folder / RECORD).rename(folder / "other.json")
    assert refusal(folder, folder) == " is not an asset: it has no asset.json"
    (folder / RECORD).write_text((folder / "other.json").read_text()[:300])
    assert "not a readable JSON file" in refusal(folder, folder / RECORD)
    (folder / "other.json").rename(folder / RECORD)
    (folder / PLY).unlink()
    assert "not a splat" in refusal(folder, folder / PLY)


def test_too_many_gaussians_and_none_are_refused(folder, monkeypatch):
    monkeypatch.setattr(asset_module, "MAX_GAUSSIANS", 25)
    assert len(read_asset(folder).gaussians) == 25
    monkeypatch.setattr(asset_module, "MAX_GAUSSIANS", 24)
    assert refusal(folder, folder / PLY) == ": it has 25 Gaussians; an asset has 1 to 24"
    write_splat_ply(folder / PLY, some_gaussians(25, 1, seed=0)[:0], {})
    assert refusal(folder, folder / PLY) == ": it has 0 Gaussians; an asset has 1 to 24"


def test_values_that_are_no_numbers_are_refused(folder):
    gaussians = some_gaussians(25, 1, seed=0)
    gaussians.means[7, 1] = float("nan")
    write_splat_ply(folder / PLY, gaussians, {})
    assert "y is NaN or Inf in 1 of 25 Gaussians" in refusal(folder, folder / PLY)
    echoes = {name: np.zeros(25, np.float32) for name in LIDAR}
    echoes["lidar_5"][3] = np.inf
    write_splat_ply(folder / PLY, some_gaussians(25, 1, seed=0), {}, echoes)
    assert refusal(folder, folder / PLY) == ": lidar_0 to lidar_7 contain NaN or Inf"


# ---- the actors of a model


def found_in(
    model: SplatModel, scene: Scene, holdout: HoldoutSettings = EVERY_IMAGE, **quality: Any
) -> dict[str, Asset]:
    """The assets of a model by their tracks."""
    found = assets_of(model, scene, holdout, "street", quality, {"stage": "actor_assets"})
    return {asset.source["track"]: asset for asset in found}


def test_an_asset_at_the_pose_of_its_actor_is_the_actor_in_the_colours_of_its_largest_image(model, scene):
    asset = found_in(model, scene)[AHEAD]
    rows, pose = model.of_track(AHEAD), model.rigid_groups(0.0)[AHEAD].motion.poses(np.zeros(1))[0]
    actor = model.at(0.0)[rows]  # the camera is slower, so that it sees the car best in its first image
    expected = replace(placed(asset.gaussians, pose), placement=None)
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        torch.testing.assert_close(expected.tensors[name], actor.tensors[name], atol=1e-4, rtol=1e-4)
    turned, wanted = (torch.nn.functional.normalize(own.quats, dim=-1) for own in (expected, actor))
    torch.testing.assert_close((turned * wanted).sum(dim=1).abs(), torch.ones(len(actor)), atol=1e-4, rtol=0.0)
    half = torch.from_numpy(asset.size / 2.0)
    assert len(asset.gaussians) == 30 and (asset.gaussians.means.abs() <= half).all()


def test_assets_are_named_after_scene_method_and_track_and_say_where_they_come_from(model, scene):
    found = found_in(model, scene, **{AHEAD: {"psnr": 20.0}})
    assert [asset.name for asset in found.values()] == [f"0001/street/{id}" for id in (AHEAD, TURNING, GONE)]
    for id, asset in found.items():
        track = scene.track(id)
        assert (asset.object_class, asset.category) == (track.object_class, track.category)
        np.testing.assert_array_equal(asset.size, track.size)
        assert asset.source == {"dataset": scene.dataset, "scene": "0001", "method": "street", "track": id}
        assert asset.quality == ({"psnr": 20.0} if id == AHEAD else {})
        assert not asset.invented.any() and asset.gait is None and asset.ground is None
        assert asset.provenance == {"stage": "actor_assets"}


def test_the_sides_that_were_seen_are_those_that_face_the_cameras(model, scene):
    """One drives ahead of the camera, one comes towards it."""
    found = found_in(model, scene)
    assert len(found[AHEAD].seen) and (np.cos(found[AHEAD].seen) < -0.95).all()
    assert len(found[TURNING].seen) and (np.cos(found[TURNING].seen) > 0.5).all()


def test_gaussians_that_show_nothing_are_left_out(scene):
    model = street_model()
    (actors,) = (part for part in model.parts if part.moves)
    own = torch.arange(30)
    with torch.no_grad():
        actors.params["opacities"][own[:4]] = torch.logit(torch.tensor(0.004))
        actors.params["opacities"][own[4:6]] = torch.logit(torch.tensor(0.006))
        actors.params["means"][own[9]] = float("nan")
    found = found_in(model, scene)[AHEAD].gaussians
    kept = torch.tensor([i not in (0, 1, 2, 3, 9) for i in range(30)])
    torch.testing.assert_close(found.means, actors.params["means"][own][kept])


def test_objects_that_no_training_image_shows_are_left_out(model, scene):
    early = replace(scene, frames=tuple(f for f in scene.frames if scene.seconds(f.timestamp) < 0.2))
    assert {*found_in(model, early)} == {AHEAD, TURNING}, "the truck comes later"
    assert {*found_in(model, scene, HoldoutSettings(every_nth=0, last_block=9))} == {AHEAD, TURNING}, "held out"


def test_a_person_takes_the_gait_along(scene):
    start = scene.frames[0].ego_to_world[:3, 3] + np.array([8.0, 0.0, 0.9])
    part = walker(walking(tuple(start)))
    with torch.no_grad():
        part.shared["stride"] += 0.2
    track = replace(scene.track(AHEAD), id=part.ids[0], object_class=ObjectClass.PEDESTRIAN, size=PERSON)
    there = replace(scene, tracks=(*scene.tracks, track))
    asset = found_in(street_model(round_gaussians([[50.0, 0.0, 0.0]]), part), there)[part.ids[0]]
    assert asset.gait.cycle == pytest.approx(1.8 * 0.83 * np.exp(0.2), rel=1e-5)
    assert (asset.gait.settings, asset.gait.lattice) == (part.settings.gait, part.settings.lattice)
    torch.testing.assert_close(asset.gait.nodes, part.shared["lattice"][0].detach())
    torch.testing.assert_close(asset.gaussians.means, part.params["means"].detach())


def test_the_share_and_the_side_that_cameras_see_follow_from_their_places():
    """A camera 10 m behind a car that looks ahead, one 5 m to its left that looks at it, and one that looks away."""
    at = np.array([20.0, 0.0, 0.75])
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    right = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    offsets = np.array([[-10.0, 0.0, 0.0], [0.0, 5.0, 0.0], [10.0, 0.0, 0.0]])
    poses = np.stack([rigid(turn, at + own) for turn, own in zip((ahead, right, ahead), offsets, strict=True)])
    K = np.tile(np.array([[200.0, 0.0, 80.0], [0.0, 200.0, 60.0], [0.0, 0.0, 1.0]]), (3, 1, 1))
    cameras = TimedCameras(np.array([0.0, 0.5, 1.0]), poses, K, np.tile([160, 120], (3, 1)))
    motion = Motion(np.array([0.0, 1.0]), np.stack([rigid(np.eye(3), at)] * 2), ((0, 1),), 0.25)
    car = EditedActor.recorded("it", ObjectClass.CAR, "vehicle.car", CAR, motion)
    np.testing.assert_allclose(cameras.shares(car), [200.0 * 1.5 / 10.0 / 120.0, 200.0 * 1.5 / 5.0 / 120.0, 0.0])
    np.testing.assert_allclose(np.abs(cameras.azimuths(car)), [np.pi, np.pi / 2.0, np.nan])
    assert cameras.azimuths(car)[1] > 0.0, "to its left"
    assert np.isnan(cameras.azimuths(car, min_share=0.3)).tolist() == [True, False, True]
    absent = replace(cameras, seconds=np.array([1.2, 1.3, 0.0]))
    assert cameras.shares(car)[0] and absent.shares(car)[0] and not absent.shares(car)[1]


# ---- the stage


def test_the_stage_writes_an_index_a_folder_and_a_turntable_for_each_actor(model, scene, tmp_path):
    path = tmp_path / "assets" / "assets.json"
    write_asset(path.parent / "an_earlier_one", a_person())
    (path.parent / "notes").mkdir()
    few = street_model(round_gaussians([[50.0, 0.0, 0.0]]), street_actors())
    job = AssetsJob(holdout=EVERY_IMAGE, complete=False)
    write_assets(path, scene, checkpoint_of(few), "street", job, {AHEAD: {"psnr": 20.0}}, {"stage": "actor_assets"})
    index = json.loads(path.read_text())
    assert (index["scene"], index["method"], index["provenance"]) == ("0001", "street", {"stage": "actor_assets"})
    assert [item["track"] for item in index["assets"]] == [AHEAD, TURNING, GONE]
    assert {folder.name for folder in path.parent.iterdir() if folder.is_dir()} == {AHEAD, TURNING, GONE, "notes"}
    for item in index["assets"]:
        folder = path.parent / item["folder"]
        asset = read_asset(folder)
        assert (asset.name, len(asset.gaussians)) == (item["name"], item["gaussians"]) and not asset.invented.any()
        assert Image.open(folder / "turntable.webp").n_frames == VIEWS
    assert index["assets"][0]["quality"] == {"psnr": 20.0}
