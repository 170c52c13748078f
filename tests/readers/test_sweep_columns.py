"""The columns of sweeps by other programs: which are read, as what, and what the checker says of them."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import REPOSITORY
from plyfile import PlyData, PlyElement

from drivesplat.readers.drive.__main__ import main
from drivesplat.readers.drive.sweep_file import columns_sentence, read_file


def ply(path: Path, **columns: np.ndarray) -> Path:
    """A PLY file with five points and further columns."""
    points = {name: np.arange(1.0, 6.0, dtype=np.float32) for name in "xyz"} | columns
    vertices = np.rec.fromarrays([*points.values()], dtype=[(name, v.dtype) for name, v in points.items()])
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))
    return path


VALUES = np.array([0.0, 1.0, 30.0, 130.0, 255.0], dtype=np.float32)


@pytest.mark.parametrize("name", ["scalar_intensity", "scalar_Intensity", "Intensity", "reflectance"])
def test_intensities_of_other_programs_are_between_0_and_1(name, tmp_path):
    for factor, scaled in ((255.0, ", whose intensities are divided by 255"), (1.0, "")):
        path = ply(tmp_path / "top.ply", **{name: VALUES * np.float32(factor / 255.0), "nx": VALUES})
        np.testing.assert_allclose(read_file(path).intensity, VALUES / 255.0, atol=1e-6)
        assert columns_sentence(path) == f"has x, y, z, intensity ({name}){scaled}; not used: nx"
    path = ply(tmp_path / "top.ply", **{name: np.array([0, 0, 1, 1, 0], dtype=np.uint8)})
    np.testing.assert_allclose(read_file(path).intensity.max(), 1.0 / 255.0), "8 bits count to 255, however dark"


def test_values_that_no_rule_covers_are_refused(tmp_path):
    for columns, words in (
        ({"scalar_intensity": 300.0 * VALUES}, "divide them"),
        ({"intensity": VALUES}, "has intensities up to 255; divide them"),
        ({"ring": np.array([0.0, 1.0, 2.0, 3.0, 1e18])}, "has rings from 0 to 1e+18; they are indices of beams"),
        ({"ring": np.array([0.0, 1.0, 2.0, 3.0, np.nan])}, "they are indices of beams"),
    ):
        assert words in str(read_file(ply(tmp_path / "top.ply", **columns)))
    np.savez(tmp_path / "top.npz", points=np.zeros((5, 3)))
    assert "it has no x, y, z; its columns are points" in str(read_file(tmp_path / "top.npz"))
    (tmp_path / "top.bin").write_bytes(bytes(160))
    words = "is no sweep that can be read: sweeps are .npz, .ply, .pcd files (docs/own_data.md)"
    assert read_file(tmp_path / "top.bin") == words


def test_a_column_of_the_documented_name_counts_before_others(tmp_path):
    path = ply(tmp_path / "top.ply", scalar_intensity=VALUES, intensity=VALUES / np.float32(512.0))
    np.testing.assert_array_equal(read_file(path).intensity, VALUES / np.float32(512.0))
    assert columns_sentence(path) == "has x, y, z, intensity; not used: scalar_intensity"


def test_the_checker_names_the_columns_of_each_lidar(tmp_path, capsys):
    ply(tmp_path / "one.ply", scalar_intensity=VALUES, scalar_GpsTime=VALUES)
    pose = {"translation": [0.0, 0.0, 1.0], "rotation": [1.0, 0.0, 0.0, 0.0]}
    drive = {
        "format": "drivesplat drive", "version": 1, "lidars": {"top": {"sensor_to_ego": pose}},
        "sweeps": [{"lidar": "top", "timestamp": 1_000_000, "file": "one.ply", "lidar_to_world": pose}],
    }  # fmt: skip
    (tmp_path / "drive.json").write_text(json.dumps(drive))
    assert main(["check", str(tmp_path)]) == 1, "no method renders a LiDAR without rings, and there are no images"
    expected = (
        "  LiDAR top: 1 sweep; the first has x, y, z, intensity (scalar_intensity), whose intensities are divided by "
        "255; not used: scalar_GpsTime"
    )
    assert expected in capsys.readouterr().out.splitlines()


def test_a_file_of_cloudcompare_is_read():
    path = REPOSITORY.parent / "shared/data/odd-inputs/cloudcompare.ply"
    if not path.is_file():
        pytest.skip(f"no PLY file of CloudCompare at {path}")
    given = PlyData.read(str(path))["vertex"]["scalar_intensity"]
    np.testing.assert_allclose(read_file(path).intensity, given / 255.0, atol=1e-6)
