"""Assets of other programs: an import is what was there, an export comes back, and bad files are named."""

import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from helpers.hand_made_assets import CAR, filled_car
from helpers.hand_made_street import AHEAD
from helpers.samples import EVERYTHING, sampled_with
from numpy.lib import recfunctions as structured
from plyfile import PlyData, PlyElement

from drivesplat.editing.assets import exchange
from drivesplat.editing.assets.asset import Asset, read_asset, write_asset
from drivesplat.editing.assets.exchange import FORMATS, ImportOptions, export_assets, import_assets
from drivesplat.editing.assets.inserted import part_of, with_assets
from drivesplat.errors import ConfigError, DriveSplatError, RequestError, ResultError
from drivesplat.model.actor_placements import ActorPlacement
from drivesplat.model.splat_ply import write_splat_ply
from drivesplat.scene.object_class import ObjectClass
from drivesplat.settings.asset_references import RECORD

TURNED_CAR = ImportOptions(frame="z,-x,-y", scale=0.5, object_class="car")
IDENTITY = ImportOptions(frame="x,y,z", scale=1.0, object_class="car")


@pytest.fixture(autouse=True)
def no_turntables(monkeypatch):
    """Pictures of assets take seconds each, and are tested elsewhere."""
    monkeypatch.setattr("drivesplat.editing.assets.asset_library.write_turntable", lambda path, asset: None)


@pytest.fixture(scope="module")
def car(tmp_path_factory) -> Path:
    """The folder of an asset with LiDAR logits and invented Gaussians."""
    folder, plain = tmp_path_factory.mktemp("cars") / "car", filled_car(name="0001/street/6e5c", size=CAR)
    logits = torch.randn(400, 4, 2, generator=torch.Generator().manual_seed(1))
    gaussians = replace(plain.gaussians, lidar_logits=logits)
    write_asset(folder, replace(plain, gaussians=gaussians, invented=torch.arange(400) % 3 == 0))
    return folder


def assert_same_gaussians(found: Asset, expected: Asset) -> None:
    """Also where quaternions have the other sign."""
    signs = (found.gaussians.quats * expected.gaussians.quats).sum(dim=1, keepdim=True).sign()
    turned = replace(found.gaussians, quats=found.gaussians.quats * signs)
    assert turned.tensors.keys() == expected.gaussians.tensors.keys()
    for name, values in expected.gaussians.tensors.items():
        torch.testing.assert_close(turned.tensors[name], values, atol=2e-5, rtol=1e-4)
    assert torch.equal(found.invented, expected.invented)


# ---- out and in again

ROUND_TRIPS = {
    "asset_harvester": (None, ImportOptions()),
    "splatsim": (None, ImportOptions()),
    "hugsim": (None, ImportOptions()),
    "ply": ("-y,z,-x", ImportOptions(frame="-y,z,-x", scale=0.01, origin="file", object_class="car", size=tuple(CAR))),
}


@pytest.mark.parametrize("named", FORMATS)
def test_an_asset_that_was_exported_comes_back(named, car, tmp_path):
    frame, options = ROUND_TRIPS[named]
    files = export_assets([car], named, tmp_path / "out", frame, options.scale)
    path = files[0] if named == "ply" else tmp_path / "out"
    assert all(file.is_file() for file in files)
    assert import_assets(path, tmp_path / "library", options) == ["0001_street_6e5c"]
    found, expected = read_asset(tmp_path / "library/0001_street_6e5c"), read_asset(car)
    assert_same_gaussians(found, expected)
    assert found.object_class is ObjectClass.CAR
    np.testing.assert_allclose(found.size, CAR, atol=1e-6)
    assert found.source["format"] == named and found.provenance["import"]["frame"] == (frame or FORMATS[named].FRAME)


@pytest.mark.parametrize("named", ["asset_harvester", "splatsim", "hugsim"])
def test_several_assets_in_a_folder_are_exported_and_imported_together(named, tmp_path):
    kinds = {"car": CAR, "bus": np.array([8.0, 2.4, 2.8]), "pedestrian": np.array([0.6, 0.6, 1.8])}
    folders = []
    for kind, size in kinds.items():
        asset = filled_car(100, 0, name=kind, size=size, object_class=ObjectClass(kind))
        stretched = asset.gaussians.means * torch.from_numpy(size / CAR).float()
        write_asset(tmp_path / kind, replace(asset, gaussians=replace(asset.gaussians, means=stretched)))
        folders.append(tmp_path / kind)
    for folder in folders:  # one after the other: the index grows
        export_assets([folder], named, tmp_path / "out")
    expected = {name: "car" if named == "hugsim" else name for name in kinds}
    assert sorted(import_assets(tmp_path / "out", tmp_path / "library", ImportOptions())) == sorted(kinds)
    for name, size in kinds.items():
        found = read_asset(tmp_path / "library" / name)
        assert found.object_class == expected[name]
        np.testing.assert_allclose(found.size, size)
    index = json.loads((tmp_path / "library/library.json").read_text())
    assert [own["id"] for own in index["assets"]] == sorted(kinds)


def test_the_files_of_a_format_are_those_that_its_program_reads(car, tmp_path):
    export_assets([car], "asset_harvester", tmp_path)
    (record,) = yaml.safe_load((tmp_path / "metadata.yaml").read_text())["assets"].values()
    assert record == {
        "ply_file": "automobile/0001_street_6e5c/gaussians.ply", "label_class": "automobile",
        "cuboids_dims": [4.0, 2.0, 1.5],
    }  # fmt: skip
    own = PlyData.read(tmp_path / record["ply_file"])["vertex"]
    means = read_asset(car).gaussians.means.numpy() / 4.0
    np.testing.assert_allclose(np.stack([own["x"], own["y"], own["z"]]), [-means[:, 1], -means[:, 2], means[:, 0]])
    export_assets([car], "splatsim", tmp_path)
    bank = json.loads((tmp_path / "actor_assets.json").read_text())
    assert (bank["schema"], bank["frame"], bank["instances"]) == ("splatsim.actor_assets/v1", "object", [])
    (record,) = bank["assets"]
    assert (record["uri"], record["class_name"], record["n_points"]) == (
        "parts/0001_street_6e5c.ply",
        "automobile",
        400,
    )
    assert (record["sh_degree"], record["size"]) == (3, [4.0, 2.0, 1.5])
    export_assets([car], "hugsim", tmp_path)
    assert json.loads((tmp_path / "0001_street_6e5c/wlh.json").read_text()) == [2.0, 4.0, 1.5]


def test_a_plain_splat_gets_the_middle_and_the_size_of_its_gaussians(tmp_path):
    """In half metres, y down and z forward, and far off its origin."""
    asset = filled_car(2000)
    own = exchange.AssetFrame.parse("z,-x,-y", 0.5).from_object(asset.gaussians)
    write_splat_ply(tmp_path / "my car.ply", replace(own, means=own.means + torch.tensor([10.0, -4.0, 7.0])), {})
    assert import_assets(tmp_path / "my car.ply", tmp_path / "library", TURNED_CAR) == ["my_car"]
    found = read_asset(tmp_path / "library/my_car")
    torch.testing.assert_close(found.gaussians.means, asset.gaussians.means, atol=0.05, rtol=0.0)
    np.testing.assert_allclose(found.size, CAR, atol=0.2)
    assert (found.category, found.provenance["import"]["scale"], len(found.seen)) == ("car", 0.5, 0)
    assert found.gaussians.lidar_logits is None and not found.invented.any()


def test_files_that_hugsims_converter_wrote_belong_to_the_folders_beside_them(tmp_path):
    export_assets([written(tmp_path, filled_car(50, name="2024_06"))], "hugsim", tmp_path / "cars")
    (tmp_path / "cars/converted").mkdir()
    (tmp_path / "cars/2024_06/2024_06.ply").rename(tmp_path / "cars/converted/2024_06.ply")
    (tmp_path / "cars/2024_06/gs.pth").write_bytes(pickle.dumps(1))
    assert import_assets(tmp_path / "cars", tmp_path / "library", ImportOptions()) == ["2024_06"]


def written(folder: Path, asset: Asset) -> Path:
    write_asset(folder / "an asset", asset)
    return folder / "an asset"


# ---- in a drive


def test_an_imported_asset_is_inserted_without_lidar_logits_of_its_own(model, tmp_path):
    write_splat_ply(tmp_path / "car.ply", filled_car(60).gaussians, {})
    import_assets(tmp_path / "car.ply", tmp_path / "library", IDENTITY)
    asset = read_asset(tmp_path / "library/car")
    assert asset.gaussians.lidar_logits is None
    whole = with_assets(model, {"new": asset})
    found = sampled_with(whole.parts[-1], 0.0, [ActorPlacement("new", np.eye(4))], EVERYTHING)
    torch.testing.assert_close(found.means.detach(), asset.gaussians.means, atol=1e-5, rtol=1e-5)
    echo = torch.zeros(4, 2)
    echo[0] = torch.tensor([-1.0, 2.0])
    torch.testing.assert_close(part_of("new", asset, echo).params["lidar_logits"], echo.expand(60, 4, 2))
    assert AHEAD not in whole.parts[-1].ids


# ---- what is refused


def refused(path: Path, tmp_path: Path, options: ImportOptions = IDENTITY) -> str:
    with pytest.raises(DriveSplatError) as error:
        import_assets(path, tmp_path / "library", options)
    assert "\n" not in str(error.value) and not (tmp_path / "library").exists()
    return str(error.value)


@pytest.fixture
def splat(tmp_path) -> Path:
    write_splat_ply(tmp_path / "car.ply", filled_car(60).gaussians, {})
    return tmp_path / "car.ply"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"frame": None}, "the file declares no frame: give the axes of forward, left and up"),
        ({"scale": None}, "the file declares no frame"),
        ({"frame": "x,y,-z"}, "is mirrored"),
        ({"frame": "x,y,y"}, "is not orthogonal"),
        ({"object_class": None}, "the file does not say what it is"),
        ({"object_class": "dragon"}, "the class 'dragon' is unknown: give one of car, truck"),
        ({"size": (40.0, 2.0, 1.5)}, "its box of 40 x 2 x 1.5 m does not fit its class 'car'"),
        ({"object_class": "pedestrian"}, "does not fit its class 'pedestrian'"),
        ({"size": (12.0, 9.0, 9.0)}, "which does not fit its box of 12 x 9 x 9 m"),
        ({"scale": 9.0}, "does not fit its class 'car' (0.1 to 30 m)"),
        ({"origin": "there"}, "the origin 'there' is neither of box and file"),
        ({"name": "---"}, "'---' is no name of an asset"),
        ({"format": "obj"}, "there is no format 'obj'; known are asset_harvester, splatsim, hugsim, ply"),
    ],
)
def test_options_that_do_not_fit_are_refused(changes, said, splat, tmp_path):
    assert said in refused(splat, tmp_path, replace(IDENTITY, **changes))


def columns(path: Path, changed: Callable[[np.ndarray], np.ndarray]) -> None:
    """Changes the vertices of a PLY file."""
    vertices = changed(PlyData.read(path, mmap=False)["vertex"].data)
    PlyData([PlyElement.describe(structured.repack_fields(vertices), "vertex")]).write(path)


def test_damaged_gaussians_are_refused(splat, tmp_path):
    whole = splat.read_bytes()

    def said(change: Callable[[np.ndarray], np.ndarray]) -> str:
        splat.write_bytes(whole)
        columns(splat, change)
        return refused(splat, tmp_path)

    def with_values(name: str, value: float) -> Callable[[np.ndarray], np.ndarray]:
        def changed(vertices: np.ndarray) -> np.ndarray:
            vertices[name][3] = value
            return vertices

        return changed

    assert "z is NaN or Inf in 1 of 60 Gaussians" in said(with_values("z", np.nan))
    assert "an infinite scale" in said(with_values("scale_1", 200.0))
    assert "not a splat in the 3DGS convention" in said(lambda own: own[[n for n in own.dtype.names if n != "rot_2"]])
    assert "not a splat in the 3DGS convention" in said(lambda own: own[["x", "y", "z"]])
    splat.write_bytes(whole[:-100])
    assert "not a splat" in refused(splat, tmp_path)
    splat.write_bytes(whole.replace(b"vertex 60", b"vertex 10000000"))
    assert "it has 10,000,000 Gaussians; an asset has 1 to 2,000,000" in refused(splat, tmp_path)
    splat.write_bytes(b"<html>")
    assert "not a splat" in refused(splat, tmp_path)
    write_splat_ply(splat, filled_car(60, 4).gaussians, {})
    assert "its colours have degree 4; at most 3 is read" in refused(splat, tmp_path)


def test_a_rotation_of_length_0_is_refused(splat, tmp_path):
    def changed(vertices: np.ndarray) -> np.ndarray:
        for i in range(4):
            vertices[f"rot_{i}"][0] = 0.0
        return vertices

    columns(splat, changed)
    assert "have no rotation" in refused(splat, tmp_path)


def test_paths_of_no_format_are_refused(tmp_path):
    assert refused(tmp_path / "none.ply", tmp_path) == f"there is no {tmp_path / 'none.ply'}"
    (tmp_path / "empty").mkdir()
    assert "is of no known format" in refused(tmp_path / "empty", tmp_path)
    for named in ("splatsim", "asset_harvester", "hugsim", "ply"):
        refused(tmp_path / "empty", tmp_path, ImportOptions(format=named))


def test_a_pickle_is_never_read(tmp_path):
    (tmp_path / "car").mkdir()
    (tmp_path / "car/gs.pth").write_bytes(pickle.dumps(1))
    (tmp_path / "car/wlh.json").write_text("[2, 4, 1.5]")
    for path in (tmp_path / "car", tmp_path / "car/gs.pth", tmp_path):
        said = refused(path, tmp_path, ImportOptions())
        assert "is a pickle" in said and "convert_vehicles.py" in said


@pytest.fixture
def exported(car, tmp_path) -> Path:
    for named in ("asset_harvester", "splatsim", "hugsim"):
        export_assets([car], named, tmp_path / named)
    return tmp_path


HARVESTER = {
    "no YAML": ("{", "metadata.yaml, line 1: not YAML"),
    "no assets": ("assets: {}", "it lists no assets"),
    "a list": ("[1]", "it lists no assets"),
    "no size": ("assets: {a: {ply_file: a.ply, label_class: car}}", "'a' lacks one of ply_file"),
    "two edges": ("assets: {a: {ply_file: a.ply, label_class: car, cuboids_dims: [1, 2]}}",
                  "cuboids_dims [1, 2] is not three lengths in metres"),
    "a path outside": ("assets: {a: {ply_file: ../a.ply, label_class: car, cuboids_dims: [4, 2, 1]}}",
                       "the path '../a.ply' leads out of the folder of the index"),
    "an absolute path": ("assets: {a: {ply_file: /etc/passwd, label_class: car, cuboids_dims: [4, 2, 1]}}",
                         "the path '/etc/passwd' leads out of"),
    "no file": ("assets: {a: {ply_file: b/a.ply, label_class: car, cuboids_dims: [4, 2, 1]}}", "there is no "),
}  # fmt: skip


@pytest.mark.parametrize(("text", "said"), HARVESTER.values(), ids=HARVESTER)
def test_an_index_of_asset_harvester_that_is_none_is_refused(text, said, exported):
    (exported / "asset_harvester/metadata.yaml").write_text(text)
    (exported / "a.ply").touch()
    assert said in refused(exported / "asset_harvester", exported, ImportOptions())


def test_files_that_were_turned_for_nurec_are_refused(exported):
    """Its script turns positions by -90 degrees about y, quaternions the other way."""

    def turned(vertices: np.ndarray) -> np.ndarray:
        vertices["x"], vertices["z"] = -vertices["z"].copy(), vertices["x"].copy()
        return vertices

    columns(next((exported / "asset_harvester").rglob("*.ply")), turned)
    assert "does not fit its box" in refused(exported / "asset_harvester", exported, ImportOptions())


BANKS = {
    "no JSON": (lambda bank: "{", "actor_assets.json: not a readable JSON file"),
    "another version": (lambda bank: {**bank, "schema": "splatsim.actor_assets/v2"}, "its schema is 'splatsim.actor"),
    "a list": (lambda bank: [], "its schema is None"),
    "another frame": (lambda bank: {**bank, "object_frame": {"up": "+y"}}, "does not declare the object frame"),
    "no assets": (lambda bank: {**bank, "assets": []}, "it lists no assets"),
    "no class": (lambda bank: {**bank, "assets": [{"asset_id": "a"}]}, "lacks one of asset_id, uri"),
    "SPZ": (lambda bank: with_asset(bank, uri="actor_assets/a/asset.spz"), "are SPZ, which is not read"),
    "a path outside": (lambda bank: with_asset(bank, uri="../a.ply"), "the path '../a.ply' leads out of"),
    "a flat box": (lambda bank: with_asset(bank, size=[4.0, 0.0, 1.5]), "is not three lengths in metres"),
    "a walker": (lambda bank: with_asset(bank, motion="articulated"), "is 'articulated', not 'rigid'"),
    "an unknown class": (lambda bank: with_asset(bank, class_name="ufo"), "the class 'ufo' is unknown"),
}


def with_asset(bank: dict, **changes) -> dict:
    return {**bank, "assets": [{**bank["assets"][0], **changes}]}


@pytest.mark.parametrize(("changed", "said"), BANKS.values(), ids=BANKS)
def test_a_bank_of_splatsim_that_is_none_is_refused(changed, said, exported):
    path = exported / "splatsim/actor_assets.json"
    content = changed(json.loads(path.read_text()))
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    assert said in refused(exported / "splatsim", exported, ImportOptions())


@pytest.mark.parametrize("text", ["{", "[2, 4]", '["a", 1, 2]', "[2, -4, 1.5]", "null"])
def test_a_size_of_hugsim_that_is_none_is_refused(text, exported):
    (exported / "hugsim/0001_street_6e5c/wlh.json").write_text(text)
    assert "wlh.json: " in refused(exported / "hugsim", exported, ImportOptions())


def test_a_link_that_leads_out_of_the_folder_is_refused(exported, splat):
    own = next((exported / "splatsim").rglob("*.ply"))
    own.unlink()
    own.symlink_to(splat)
    assert "leads out of the folder of the index" in refused(exported / "splatsim", exported, ImportOptions())


def test_one_name_and_one_size_are_for_one_asset(exported, car, tmp_path):
    shutil.copytree(car, tmp_path / "second")
    record = json.loads((tmp_path / "second" / RECORD).read_text())
    (tmp_path / "second" / RECORD).write_text(json.dumps({**record, "name": "second"}))
    export_assets([tmp_path / "second"], "splatsim", exported / "splatsim")
    for options in (ImportOptions(name="it"), ImportOptions(size=(4.0, 2.0, 1.5))):
        assert "has 2 assets: a name and a size" in refused(exported / "splatsim", exported, options)


def test_what_cannot_be_exported_is_named(car, tmp_path):
    with pytest.raises(RequestError, match="there is no format 'obj'"):
        export_assets([car], "obj", tmp_path)
    with pytest.raises(ResultError, match="is not an asset: it has no"):
        export_assets([tmp_path], "ply", tmp_path / "out")
    with pytest.raises(RequestError, match="is mirrored"):
        export_assets([car], "ply", tmp_path / "out", "x,z,y")
    (tmp_path / "metadata.yaml").write_text("{")
    with pytest.raises(ConfigError, match="not YAML"):
        export_assets([car], "asset_harvester", tmp_path)
