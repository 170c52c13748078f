"""splat.ply: the layout that viewers expect, Gaussians that return, foreign files refused."""

import json

import numpy as np
import pytest
import torch
from helpers import hand_made_street
from helpers.hand_made import recording_of
from plyfile import PlyData, PlyElement

from drivesplat.errors import ResultError
from drivesplat.export.splat_asset import SplatFiles, export_splat
from drivesplat.export.trained_parts import trained_gaussians
from drivesplat.model.background import Background
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.splat_ply import note_of, read_splat_ply, write_splat_ply
from drivesplat.settings.export import SplatJob
from drivesplat.settings.train import GaussianSettings, TrainSettings

DIGESTS = {"settings_sha256": "a" * 64, "code_sha256": "b" * 64, "inputs_sha256": "c" * 64}
PROVENANCE = {**DIGESTS, "stages": {"train": {"settings": {"long": "x" * 20_000}}}}


def some_gaussians(count: int = 30, sh_degree: int = 3, seed: int = 0) -> Gaussians:
    """Gaussians two to six metres before a camera at the origin, with quaternions of any length."""
    generator = torch.Generator().manual_seed(seed)
    random = torch.rand(count, 8, generator=generator)
    return Gaussians.of(
        means=random[:, :3] * torch.tensor([4.0, 3.0, 4.0]) + torch.tensor([-2.0, -1.5, 2.0]),
        quats=torch.randn(count, 4, generator=generator) * 3.0,
        scales=torch.exp(4.0 * random[:, 3:6] - 4.0),
        opacities=random[:, 6],
        sh=torch.randn(count, (sh_degree + 1) ** 2, 3, generator=generator) * 0.3,
    )


def checkpoint_of(params: dict[str, torch.Tensor], sh_degree: int) -> TrainedCheckpoint:
    """What a training of a background with these parameters would have left."""
    settings = TrainSettings(gaussians=GaussianSettings(sh_degree=sh_degree))
    return hand_made_street.checkpoint_of(SplatModel([Background(params, settings.gaussians, 1.0)], None), settings)


def trained_params(count: int, sh_degree: int) -> dict[str, torch.Tensor]:
    """Parameters as they are optimised: logits, logarithms."""
    shown = some_gaussians(count, sh_degree)
    return {
        "means": shown.means, "quats": shown.quats, "scales": torch.log(shown.scales),
        "opacities": torch.logit(shown.opacities), "sh0": shown.sh[:, :1], "shN": shown.sh[:, 1:],
    }  # fmt: skip


@pytest.mark.parametrize(("sh_degree", "rest"), [(0, 0), (1, 9), (2, 24), (3, 45)])
def test_the_layout_is_that_of_the_convention_values_precede_the_activations_and_return(tmp_path, sh_degree, rest):
    shown = some_gaussians(sh_degree=sh_degree)
    write_splat_ply(tmp_path / "splat.ply", shown, {})
    data = PlyData.read(str(tmp_path / "splat.ply"))
    assert [element.name for element in data.elements] == ["vertex"] and not data.text and data.byte_order == "<"
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [f"f_rest_{i}" for i in range(rest)]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    vertices = data["vertex"]
    assert [p.name for p in vertices.properties] == expected
    assert {p.val_dtype for p in vertices.properties} == {"f4"}

    def columns(*names: str) -> np.ndarray:
        return np.stack([np.asarray(vertices[name], dtype=np.float64) for name in names], axis=1)

    np.testing.assert_array_equal(columns("x", "y", "z"), shown.means)
    np.testing.assert_array_equal(columns("nx", "ny", "nz"), 0.0)
    np.testing.assert_array_equal(columns("f_dc_0", "f_dc_1", "f_dc_2"), shown.sh[:, 0])
    np.testing.assert_allclose(1 / (1 + np.exp(-columns("opacity")[:, 0])), shown.opacities, rtol=1e-6)
    np.testing.assert_allclose(np.exp(columns("scale_0", "scale_1", "scale_2")), shown.scales, rtol=1e-6)
    unit = shown.quats / shown.quats.norm(dim=-1, keepdim=True)
    np.testing.assert_allclose(columns("rot_0", "rot_1", "rot_2", "rot_3"), unit, atol=1e-6)
    again = read_splat_ply(tmp_path / "splat.ply")
    for name, given in {**vars(shown), "quats": unit}.items():
        torch.testing.assert_close(getattr(again, name), given, rtol=1e-5, atol=1e-6)


def test_the_header_suits_viewers_with_simple_parsers(tmp_path):
    """SIBR takes the count from the third line; antimatter15's viewer looks at the first 10 kB."""
    write_splat_ply(tmp_path / "splat.ply", some_gaussians(7), {"scene": "ä"})
    content = (tmp_path / "splat.ply").read_bytes()
    lines = content[: content.index(b"end_header\n")].decode("ascii").splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 7"]
    notes = [line.removeprefix("comment drivesplat ") for line in lines if line.startswith("comment")]
    assert [json.loads(note) for note in notes] == [{"scene": "ä"}]
    assert len(content) == content.index(b"end_header\n") + len(b"end_header\n") + 7 * 62 * 4


def test_extreme_opacities_and_scales_are_stored_as_finite_values(tmp_path):
    shown = some_gaussians(6)
    shown.opacities.copy_(torch.tensor([0.0, 1e-30, 1e-6, 1 - 1e-6, 1 - 2**-24, 1.0]))
    shown.scales.copy_(torch.tensor([0.0, 1e-20, 1e4]))
    write_splat_ply(tmp_path / "splat.ply", shown, {})
    vertices = PlyData.read(str(tmp_path / "splat.ply"))["vertex"]
    assert all(np.isfinite(vertices[name]).all() for name in ("opacity", "scale_0", "scale_1", "scale_2"))
    again = read_splat_ply(tmp_path / "splat.ply")
    torch.testing.assert_close(again.opacities, shown.opacities, rtol=1e-5, atol=1e-37)
    torch.testing.assert_close(again.scales, shown.scales, rtol=1e-5, atol=1e-37)


def test_a_splat_truncated_anywhere_is_refused_naming_file_and_rule(tmp_path):
    write_splat_ply(tmp_path / "whole.ply", some_gaussians(2, sh_degree=0), {"scene": "a"})
    whole = (tmp_path / "whole.ply").read_bytes()
    for length in (*range(0, len(whole), 7), len(whole) - 1):
        (tmp_path / "cut.ply").write_bytes(whole[:length])
        with pytest.raises(ResultError, match=r"cut\.ply.*'export'"):
            read_splat_ply(tmp_path / "cut.ply", "export")


def ply_of(names: list[str], value: float = 0.0, element: str = "vertex") -> PlyElement:
    return PlyElement.describe(np.full(2, value, dtype=[(name, "f4") for name in names]), element)


SH0 = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
]  # fmt: skip


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(ply_of(["x", "y", "z", "red", "green", "blue"]), id="a point cloud"),
        pytest.param(ply_of([name for name in SH0 if name != "rot_3"]), id="no rot_3"),
        pytest.param(ply_of([*SH0, "f_rest_0"]), id="one coefficient too many"),
        pytest.param(ply_of([*SH0, *(f"f_rest_{i}" for i in range(42))]), id="no whole degree"),
        pytest.param(ply_of([*SH0, *(f"f_rest_{i}" for i in range(1, 10))]), id="coefficients misnamed"),
        pytest.param(ply_of(SH0, np.nan), id="not finite"),
        pytest.param(ply_of(["x"], element="face"), id="no vertices"),
        None, b"", b"not a ply", b"\x89PNG\r\n\x1a\n",
    ],
)  # fmt: skip
def test_a_file_of_something_else_is_refused_without_advice_to_delete_it(tmp_path, content):
    path = tmp_path / "foreign.ply"
    if isinstance(content, PlyElement):
        PlyData([content]).write(str(path))
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(ResultError, match=r"foreign\.ply: not a splat in the 3DGS convention") as refused:
        read_splat_ply(path)
    assert "delete" not in str(refused.value) and "export" not in str(refused.value)


def test_infinite_opacities_are_one_and_zero(tmp_path):
    element = ply_of(SH0, value=0.5)
    element.data["opacity"] = [np.inf, -np.inf]
    PlyData([element]).write(str(tmp_path / "other.ply"))
    assert read_splat_ply(tmp_path / "other.ply").opacities.tolist() == [1.0, 0.0]
    element.data["opacity"] = [np.nan, 0.0]
    PlyData([element]).write(str(tmp_path / "other.ply"))
    with pytest.raises(ResultError, match="opacity is NaN or Inf in 1 of 2 Gaussians"):
        read_splat_ply(tmp_path / "other.ply")


def exported(folder, params, scene, job: SplatJob) -> SplatFiles:
    """What the stage writes into `folder` for a background with these parameters, of degree 2."""
    names = ("splat.ply", "cameras.json", "parts/parts.json", "transforms.json")
    files = SplatFiles(*(folder / name for name in names))
    export_splat(files, checkpoint_of(params, 2), recording_of(scene).record, scene, job, PROVENANCE)
    return files


def test_the_stage_exports_every_gaussian_of_the_checkpoint(tmp_path, tiny_scene):
    params = trained_params(50, sh_degree=2)
    files = exported(tmp_path, params, tiny_scene, SplatJob())
    splat, cameras = files.splat, files.cameras
    vertices = PlyData.read(str(splat))["vertex"]
    np.testing.assert_array_equal(vertices["y"], params["means"][:, 1])
    np.testing.assert_allclose(vertices["opacity"], params["opacities"], atol=1e-5)
    np.testing.assert_allclose(vertices["scale_2"], params["scales"][:, 2], atol=1e-5)
    np.testing.assert_array_equal(vertices["f_rest_9"], params["shN"][:, 1, 1])
    assert note_of(splat) == {"scene": "0001", "origin": tiny_scene.origin.tolist(), **DIGESTS}
    assert splat.read_bytes().index(b"end_header\n") < 8_000
    assert json.loads(cameras.read_text())["provenance"] == PROVENANCE


@pytest.mark.parametrize(("asked", "degree"), [(3, 3), (2, 2), (1, 2), (None, 2)])
def test_harmonics_have_at_least_the_degree_asked_for(tmp_path, tiny_scene, asked, degree):
    """Coefficients that the training does not have are 0: the colours stay as they are."""
    params = trained_params(20, sh_degree=2)
    files = exported(tmp_path, params, tiny_scene, SplatJob(sh_degree=asked))
    (part,) = json.loads(files.parts.read_text())["parts"]
    assert part["sh_degree"] == degree
    for path in (files.splat, files.parts.with_name(part["file"])):
        names = [p.name for p in PlyData.read(str(path))["vertex"].properties]
        assert sum(name.startswith("f_rest_") for name in names) == 3 * ((degree + 1) ** 2 - 1)
        sh = read_splat_ply(path).sh
        assert torch.equal(sh[:, 1:9], params["shN"]) and not sh[:, 9:].any()


def test_gaussians_with_nan_or_inf_are_dropped(tiny_scene):
    params = trained_params(10, sh_degree=1)
    for row, name in enumerate(("means", "quats", "scales", "opacities", "sh0", "shN")):
        params[name][row] = torch.nan
    kept = trained_gaussians(trained_model(checkpoint_of(params, 1)), tiny_scene)
    assert torch.equal(kept.means, params["means"][6:])
