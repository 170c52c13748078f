"""splat.ply and splat.spz as gsply reads them, splat.sog as its own program reads it; a sentence where a program is
missing."""

import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch

from drivesplat.errors import DriveSplatError
from drivesplat.export.compressed import SOG_PROGRAM, export_sog, export_spz
from drivesplat.export.splat_ply import read_splat_ply, write_splat_ply
from drivesplat.model.gaussians import Gaussians, with_sh_degree

COUNT = 200


def splats(sh_degree: int) -> Gaussians:
    """Gaussians up to a kilometre away."""
    generator = torch.Generator().manual_seed(0)
    random = torch.rand(COUNT, 8, generator=generator)
    quats = torch.nn.functional.normalize(torch.randn(COUNT, 4, generator=generator), dim=-1)
    sh = (0.3 * torch.randn(COUNT, (sh_degree + 1) ** 2, 3, generator=generator)).clamp(-0.98, 0.98)
    means, scales = 2000.0 * random[:, :3] - 1000.0, torch.exp(6.0 * random[:, 3:6] - 5.0)
    return Gaussians.of(means, quats, scales, 0.02 + 0.96 * random[:, 6], sh)


@pytest.fixture
def gsply():
    return pytest.importorskip("gsply", reason="gsply is not installed: make setup")


def axes(quats: np.ndarray) -> np.ndarray:
    """Quaternions with a positive largest component: q and -q are the same rotation."""
    largest = np.take_along_axis(quats, np.abs(quats).argmax(axis=1, keepdims=True), axis=1)
    return quats * np.sign(largest) / np.linalg.norm(quats, axis=1, keepdims=True)


def coefficients(harmonics: np.ndarray | None) -> np.ndarray:
    """Harmonics (n, k - 1, 3) as gsply has them: None where there are none."""
    return np.zeros((COUNT, 0, 3)) if harmonics is None else np.reshape(harmonics, (COUNT, -1, 3))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_reads_the_ply(tmp_path, gsply, degree):
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


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_gsply_reads_the_spz_to_the_precision_of_the_format(tmp_path, gsply, degree):
    """A kilometre in 24 bits; logarithms of scales in sixteenths, opacities in 8 bits, rotations in 10."""
    shown = splats(degree)
    write_splat_ply(tmp_path / "splat.ply", shown, {})
    export_spz(tmp_path / "splat.spz", tmp_path / "splat.ply")
    read = gsply.read_spz(tmp_path / "splat.spz")
    np.testing.assert_allclose(read.means, shown.means, atol=2.0**-12)
    np.testing.assert_allclose(read.scales, torch.log(shown.scales), atol=1 / 16)
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(-read.opacities)), shown.opacities, atol=1 / 255)
    np.testing.assert_allclose(axes(read.quats), axes(shown.quats.numpy()), atol=5e-3)
    np.testing.assert_allclose(read.sh0, shown.sh0[:, 0], atol=0.02)
    np.testing.assert_allclose(coefficients(read.shN), shown.shN, atol=1 / 128)
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["splat.ply", "splat.spz"]


def test_the_spz_is_a_quarter_of_the_ply_at_most(tmp_path, gsply):
    write_splat_ply(tmp_path / "splat.ply", with_sh_degree(splats(0), 3), {})
    export_spz(tmp_path / "splat.spz", tmp_path / "splat.ply")
    assert (tmp_path / "splat.spz").stat().st_size < (tmp_path / "splat.ply").stat().st_size / 4


def test_without_gsply_a_sentence_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gsply", None)
    write_splat_ply(tmp_path / "splat.ply", splats(0), {})
    with pytest.raises(DriveSplatError, match=r"splat\.spz needs gsply, .*export\.formats"):
        export_spz(tmp_path / "splat.spz", tmp_path / "splat.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["splat.ply"]


def test_without_splat_transform_a_sentence_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(DriveSplatError, match=r"npm install --global @playcanvas/splat-transform"):
        export_sog(tmp_path / "splat.sog", tmp_path / "splat.ply")


def program(folder, script: str) -> None:
    """A splat-transform in `folder` that does what `script` says; its last argument is the file to write."""
    path = folder / SOG_PROGRAM
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


def test_a_failing_splat_transform_is_reported_with_its_last_line(tmp_path, monkeypatch):
    program(tmp_path, "echo begins; echo no device; exit 3")
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    write_splat_ply(tmp_path / "splat.ply", splats(0), {})
    with pytest.raises(DriveSplatError, match=r"splat\.sog: splat-transform failed with status 3 \(no device\)$"):
        export_sog(tmp_path / "splat.sog", tmp_path / "splat.ply")
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
