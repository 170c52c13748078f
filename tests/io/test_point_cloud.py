"""Seed points as PLY files: round trips, readable by other programs, and errors that name file and rule."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from drivesplat.errors import ResultError
from drivesplat.io.point_cloud import PointCloud, read_ply, read_positions, write_ply
from drivesplat.model.splat_ply import read_splat_ply
from drivesplat.readers.drive.sweep_file import read_file


def some_points(count: int = 5) -> PointCloud:
    random = np.random.default_rng(1)
    positions = random.normal(0.0, 100.0, (count, 3)).astype(np.float32)
    note = {"lidar": count, "extra_points": None, "provenance": {"stages": {"extract": {"settings": {"scene": "ä"}}}}}
    return PointCloud(positions, random.integers(0, 256, (count, 3)).astype(np.uint8), note)


@pytest.mark.parametrize("count", [0, 1, 5, 1000])
def test_points_colors_and_note_survive_a_round_trip(tmp_path, count):
    points = some_points(count)
    write_ply(tmp_path / "seed.ply", points)
    again = read_ply(tmp_path / "seed.ply", rule="lidar_seed")
    assert again.positions.dtype == np.float32 and again.colors.dtype == np.uint8
    assert again.positions.shape == again.colors.shape == (count, 3)
    np.testing.assert_array_equal(again.positions, points.positions)
    np.testing.assert_array_equal(again.colors, points.colors)
    assert again.note == points.note


def test_properties_have_the_usual_names(tmp_path):
    points = some_points()
    write_ply(tmp_path / "seed.ply", points)
    vertices = PlyData.read(str(tmp_path / "seed.ply"))["vertex"]
    assert [p.name for p in vertices.properties] == ["x", "y", "z", "red", "green", "blue"]
    np.testing.assert_array_equal(vertices["z"], points.positions[:, 2])
    np.testing.assert_array_equal(vertices["green"], points.colors[:, 1])


def test_a_seed_truncated_anywhere_is_refused_naming_file_and_rule(tmp_path):
    write_ply(tmp_path / "whole.ply", some_points(3))
    whole = (tmp_path / "whole.ply").read_bytes()
    for length in range(len(whole)):
        (tmp_path / "cut.ply").write_bytes(whole[:length])
        with pytest.raises(ResultError, match=r"cut\.ply.*'lidar_seed'"):
            read_ply(tmp_path / "cut.ply", rule="lidar_seed")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a ply",
        b"\x89PNG\r\n\x1a\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999999\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\ncomment drivesplat {broken\nelement vertex 0\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\ncomment drivesplat {}\nelement face 0\nproperty float x\nend_header\n",
    ],
)
def test_a_foreign_file_is_refused_naming_file_and_rule(tmp_path, content):
    (tmp_path / "foreign.ply").write_bytes(content)
    with pytest.raises(ResultError, match=r"foreign\.ply.*'lidar_seed'"):
        read_ply(tmp_path / "foreign.ply", rule="lidar_seed")


def test_a_missing_seed_is_refused_naming_file_and_rule(tmp_path):
    with pytest.raises(ResultError, match=r"absent\.ply.*'lidar_seed'"):
        read_ply(tmp_path / "absent.ply", rule="lidar_seed")


def foreign_cloud(path) -> np.ndarray:
    """A PLY of double positions without colours or a note, as other programs write."""
    positions = np.array([[400.123456789, 1100.987654321, 2.0], [1.0, 2.0, 3.0]])
    vertices = np.array([tuple(p) for p in positions], dtype=[(name, "f8") for name in "xyz"])
    PlyData([PlyElement.describe(vertices, "vertex")], text=False).write(str(path))
    return positions


def test_a_foreign_point_cloud_is_not_a_seed_but_its_positions_can_be_read(tmp_path):
    positions = foreign_cloud(tmp_path / "foreign.ply")
    with pytest.raises(ResultError, match=r"foreign\.ply.*'lidar_seed'"):
        read_ply(tmp_path / "foreign.ply", rule="lidar_seed")
    np.testing.assert_array_equal(read_positions(tmp_path / "foreign.ply"), positions)


VERTEX = b"element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
BAD_HEADERS = {
    "endless": (b"ply\nformat ascii 1.0\ncomment " + b"x" * 3_000_000 + b"\n" + VERTEX, "no end_header within 1 MB"),
    "its end in a comment": (
        b"ply\nformat ascii 1.0\ncomment end_header\ncomment " + b"x" * 3_000_000 + b"\n" + VERTEX,
        "no end_header within 1 MB",
    ),
    "too many vertices": (
        b"ply\nformat ascii 1.0\n" + VERTEX.replace(b"1", b"9" * 15), "announces more than can be read",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_HEADERS)
def test_a_header_without_bounds_is_refused_by_every_reader(tmp_path, monkeypatch, name):
    """plyfile would read it byte by byte, or allocate what it announces."""
    content, message = BAD_HEADERS[name]
    path = tmp_path / "odd.ply"
    path.write_bytes(content)
    if "MB" in message:
        monkeypatch.setattr(PlyData, "read", lambda _: pytest.fail("plyfile reads it"))
    with pytest.raises(ValueError, match=message):
        read_positions(path)
    with pytest.raises(ResultError, match=message):
        read_ply(path, rule="lidar_seed")
    with pytest.raises(ResultError, match=message):
        read_splat_ply(path)
    assert message in str(read_file(path))


def test_a_long_comment_within_the_bound_is_read(tmp_path):
    (tmp_path / "long.ply").write_bytes(
        b"ply\r\nformat ascii 1.0\r\ncomment "
        + b"x" * 200_000
        + b"\r\n"
        + VERTEX.replace(b"\n", b"\r\n")
        + b"1 2 3\r\n"
    )
    np.testing.assert_array_equal(read_positions(tmp_path / "long.ply"), [[1, 2, 3]])
