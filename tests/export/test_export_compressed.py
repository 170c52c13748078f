"""splat.ply, splat.spz and splat.sog as other programs read them, and PlayCanvas' .compressed.ply, packed here."""

import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch
from helpers import REPOSITORY
from plyfile import PlyData, PlyElement

from drivesplat.errors import DriveSplatError, ResultError
from drivesplat.export.compressed import SOG_PROGRAM, export_sog, export_spz
from drivesplat.model.gaussians import Gaussians, with_sh_degree
from drivesplat.model.splat_ply import read_splat_ply, write_splat_ply

COUNT = 200


def splats(sh_degree: int) -> Gaussians:
    """Gaussians up to a kilometre away."""
    generator = torch.Generator().manual_seed(0)
    random = torch.rand(COUNT, 8, generator=generator)
    quats = torch.nn.functional.normalize(torch.randn(COUNT, 4, generator=generator), dim=-1)
    sh = (0.3 * torch.randn(COUNT, (sh_degree + 1) ** 2, 3, generator=generator)).clamp(-0.98, 0.98)
    means, scales = 2000.0 * random[:, :3] - 1000.0, torch.exp(6.0 * random[:, 3:6] - 5.0)
    return Gaussians.of(means, quats, scales, 0.02 + 0.96 * random[:, 6], sh)


def axes(quats: np.ndarray) -> np.ndarray:
    """Quaternions with a positive largest component: q and -q are the same rotation."""
    largest = np.take_along_axis(quats, np.abs(quats).argmax(axis=1, keepdims=True), axis=1)
    return quats * np.sign(largest) / np.linalg.norm(quats, axis=1, keepdims=True)


def coefficients(harmonics: np.ndarray | None) -> np.ndarray:
    """Harmonics (n, k - 1, 3) as gsply has them: None where there are none."""
    return np.zeros((COUNT, 0, 3)) if harmonics is None else np.reshape(harmonics, (COUNT, -1, 3))


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_gsply_reads_the_ply_and_the_spz_to_the_precision_of_the_format(tmp_path, degree):
    """The SPZ has a kilometre in 24 bits, logarithms of scales in sixteenths, opacities in 8 bits, rotations in 10."""
    gsply = pytest.importorskip("gsply", reason="gsply is not installed: make setup")
    shown = splats(degree)
    write_splat_ply(tmp_path / "splat.ply", shown, {"scene": "0001"})
    read = gsply.plyread(tmp_path / "splat.ply")
    np.testing.assert_array_equal(read.means, shown.means)
    np.testing.assert_allclose(np.exp(read.scales), shown.scales, rtol=1e-5)
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(-read.opacities)), shown.opacities, rtol=1e-5)
    np.testing.assert_allclose(axes(read.quats), axes(shown.quats.numpy()), atol=1e-5)
    np.testing.assert_array_equal(read.sh0, shown.sh0[:, 0])
    assert read.get_sh_degree() == degree
    np.testing.assert_array_equal(coefficients(read.shN), shown.shN)
    export_spz(tmp_path / "splat.spz", tmp_path / "splat.ply")
    read = gsply.read_spz(tmp_path / "splat.spz")
    np.testing.assert_allclose(read.means, shown.means, atol=2.0**-12)
    np.testing.assert_allclose(read.scales, torch.log(shown.scales), atol=1 / 16)
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(-read.opacities)), shown.opacities, atol=1 / 255)
    np.testing.assert_allclose(axes(read.quats), axes(shown.quats.numpy()), atol=5e-3)
    np.testing.assert_allclose(read.sh0, shown.sh0[:, 0], atol=0.02)
    np.testing.assert_allclose(coefficients(read.shN), shown.shN, atol=1 / 128)
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["splat.ply", "splat.spz"]
    write_splat_ply(tmp_path / "splat.ply", with_sh_degree(splats(0), 3), {})
    export_spz(tmp_path / "splat.spz", tmp_path / "splat.ply")
    assert (tmp_path / "splat.spz").stat().st_size < (tmp_path / "splat.ply").stat().st_size / 4


def test_a_missing_or_failing_program_is_named_with_what_to_do(tmp_path, monkeypatch):
    ply, sog = tmp_path / "splat.ply", tmp_path / "splat.sog"
    write_splat_ply(ply, splats(0), {})
    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(DriveSplatError, match=r"splat\.spz needs gsply, .*export\.formats"):
        export_spz(tmp_path / "splat.spz", ply)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin")
    with pytest.raises(DriveSplatError, match=r"npm install --global @playcanvas/splat-transform"):
        export_sog(sog, ply)
    program = tmp_path / SOG_PROGRAM
    program.write_text("#!/bin/sh\necho begins; echo no device; exit 3\n")
    program.chmod(0o755)
    with pytest.raises(DriveSplatError, match=r"splat\.sog: splat-transform failed with status 3 \(no device\)$"):
        export_sog(sog, ply)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["splat-transform", "splat.ply"]


@pytest.mark.skipif(shutil.which(SOG_PROGRAM) is None, reason="no @playcanvas/splat-transform on the PATH")
def test_the_sog_is_read_back_by_its_program(tmp_path):
    shown = splats(3)
    write_splat_ply(tmp_path / "splat.ply", shown, {})
    export_sog(tmp_path / "splat.sog", tmp_path / "splat.ply")
    assert "meta.json" in zipfile.ZipFile(tmp_path / "splat.sog").namelist()
    again = tmp_path / "again.ply"
    command = [SOG_PROGRAM, "--quiet", "--gpu", "cpu", str(tmp_path / "splat.sog"), str(again)]
    subprocess.run(command, check=True, capture_output=True)
    read = read_splat_ply(again)
    assert read.sh_degree == 3 and len(read) == COUNT
    # SOG sorts Gaussians: each one is compared with the nearest
    distances = torch.cdist(read.means, shown.means, compute_mode="donot_use_mm_for_euclid_dist")
    assert float(distances.amin(dim=1).max()) < 0.5
    order = distances.argmin(dim=1)
    assert order.unique().numel() == COUNT
    torch.testing.assert_close(read.opacities, shown.opacities[order], atol=0.02, rtol=0)


PACKED = 300
"""More than one chunk."""


def pack(values: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Values (n, k) in [0, 1] as fields of these widths, the first in the highest bits."""
    packed = np.zeros(len(values), dtype=np.uint64)
    for column, width in zip(values.T, bits, strict=True):
        packed = (packed << np.uint64(width)) | np.round(column * (2**width - 1)).astype(np.uint64)
    return packed.astype(np.uint32)


def packed_file(path, colors: bool, degree: int) -> dict[str, np.ndarray]:
    """Writes random Gaussians; returns them."""
    random = np.random.default_rng(0)
    given = {
        "means": random.uniform(-20.0, 20.0, (PACKED, 3)), "scales": random.uniform(-5.0, 0.0, (PACKED, 3)),
        "rgb": random.uniform(-0.5 if colors else 0.0, 1.5 if colors else 1.0, (PACKED, 3)),
        "opacities": np.append(random.uniform(0.0, 1.0, PACKED - 2), [0.0, 1.0]),
        "rest": random.uniform(-3.0, 3.0, (PACKED, 3 * ((degree + 1) ** 2 - 1))),
    }  # fmt: skip
    quats = random.normal(size=(PACKED, 4))
    given["quats"] = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    chunk_rows, parts = [], {name: [] for name in ("means", "scales", "rgb")}
    for begin in range(0, PACKED, 256):
        bounds = []
        for name in parts:
            piece = given[name][begin : begin + 256]
            low, high = piece.min(axis=0), piece.max(axis=0)
            if name == "rgb" and not colors:
                low, high = np.zeros(3), np.ones(3)
            parts[name].append((piece - low) / (high - low))
            bounds += [*low, *high]
        chunk_rows.append(tuple(bounds[: 18 if colors else 12]))
    unit = {name: np.concatenate(pieces) for name, pieces in parts.items()}
    rotation = np.zeros(PACKED, dtype=np.uint32)
    for i, quat in enumerate(given["quats"]):
        largest = int(np.argmax(np.abs(quat)))
        others = np.delete(quat * np.sign(quat[largest]), largest) / np.sqrt(2.0) + 0.5
        rotation[i] = (largest << 30) | int(pack(others[None], (10, 10, 10))[0])
    names = [
        f"{side}_{axis}" for kind in ("{}", "scale_{}") for side in ("min", "max") for axis in map(kind.format, "xyz")
    ]
    names += [f"{side}_{axis}" for side in ("min", "max") for axis in "rgb"] if colors else []
    vertices = np.zeros(PACKED, dtype=[(f"packed_{n}", "<u4") for n in ("position", "rotation", "scale", "color")])
    vertices["packed_position"], vertices["packed_rotation"] = pack(unit["means"], (11, 10, 11)), rotation
    vertices["packed_scale"] = pack(unit["scales"], (11, 10, 11))
    vertices["packed_color"] = pack(np.column_stack([unit["rgb"], given["opacities"]]), (8, 8, 8, 8))
    elements = [
        PlyElement.describe(np.array(chunk_rows, dtype=[(name, "<f4") for name in names]), "chunk"),
        PlyElement.describe(vertices, "vertex"),
    ]
    if degree:
        rest = np.round((given["rest"] + 4.0) / 8.0 * 255.0).astype(np.uint8)
        kinds = [(f"f_rest_{i}", "u1") for i in range(rest.shape[1])]
        elements.append(PlyElement.describe(np.array([tuple(row) for row in rest], dtype=kinds), "sh"))
    PlyData(elements, byte_order="<").write(str(path))
    return given


@pytest.mark.parametrize(("colors", "degree"), [(False, 0), (True, 1), (True, 3)])
def test_packed_gaussians_are_read_to_their_precision_and_too_few_chunks_refused(colors, degree, tmp_path):
    given = packed_file(tmp_path / "a.compressed.ply", colors, degree)
    read = read_splat_ply(tmp_path / "a.compressed.ply")
    np.testing.assert_allclose(read.means, given["means"], atol=0.55 * 40.0 / 1023)
    np.testing.assert_allclose(np.log(read.scales), given["scales"], atol=0.55 * 5.0 / 1023)
    same = np.abs((read.quats.numpy() * given["quats"]).sum(axis=1))
    assert same.min() > 0.999995, "the same rotation, whatever its sign"
    np.testing.assert_allclose(read.opacities, given["opacities"], atol=0.51 / 255)
    assert read.opacities[-1] == 1.0
    np.testing.assert_allclose(0.5 + 0.28209479 * read.sh0[:, 0].numpy(), given["rgb"], atol=0.55 * 2.0 / 255)
    assert read.sh_degree == degree
    channels = given["rest"].reshape(PACKED, 3, -1).transpose(0, 2, 1)
    np.testing.assert_allclose(read.shN, channels, atol=0.51 * 8.0 / 255)
    data = PlyData.read(str(tmp_path / "a.compressed.ply"))
    PlyData([PlyElement.describe(data["chunk"].data[:1], "chunk"), data["vertex"]]).write(str(tmp_path / "b.ply"))
    with pytest.raises(ResultError, match="1 chunks for 300 Gaussians"):
        read_splat_ply(tmp_path / "b.ply")


def test_a_trained_file_of_another_program_is_read():
    path = REPOSITORY.parent / "shared/data/splats-by-others/guitar.compressed.ply"
    if not path.is_file():
        pytest.skip(f"no compressed splat of another program at {path}")
    read = read_splat_ply(path)
    assert len(read) == 90_854 and (read.opacities == 1.0).sum() == 667
    np.testing.assert_allclose(np.linalg.norm(read.quats, axis=1), 1.0, atol=1e-5)
