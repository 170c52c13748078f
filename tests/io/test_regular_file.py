"""Files that a user names: pipes, devices, folders and circles of links are refused in words before they are opened."""

import os
import socket
from pathlib import Path

import pytest

from drivesplat.errors import DriveSplatError, ResultError
from drivesplat.io.array_file import read_arrays
from drivesplat.io.point_cloud import read_ply, read_positions
from drivesplat.io.regular_file import regular_file
from drivesplat.io.storage import read_json
from drivesplat.io.yaml_file import read_yaml
from drivesplat.model.splat_ply import read_splat_ply
from drivesplat.readers.drive.format import structure_of
from drivesplat.readers.drive.nerfstudio_file import content_of
from drivesplat.readers.drive.sweep_file import read_file


def circle(path: Path) -> None:
    path.symlink_to(path)


def to_zeros(path: Path) -> None:
    path.symlink_to("/dev/zero")


def listening(path: Path) -> None:
    socket.socket(socket.AF_UNIX).bind(str(path))


SPECIAL = {
    os.mkfifo: "it is a pipe, not a regular file",
    os.mkdir: "it is a folder, not a regular file",
    to_zeros: "it is a device, not a regular file",
    listening: "it is a socket, not a regular file",
    circle: "Too many levels of symbolic links",
}


@pytest.mark.parametrize(("make", "message"), SPECIAL.items(), ids=lambda item: getattr(item, "__name__", ""))
def test_what_is_no_regular_file_is_refused_with_what_it_is(tmp_path, monkeypatch, make, message):
    monkeypatch.chdir(tmp_path)  # the path of a socket is short
    make(Path("given"))
    with pytest.raises(OSError) as refusal:
        regular_file("given")
    assert str(refusal.value) == message


def a_device(path: Path) -> None:
    path.symlink_to(os.devnull)


READERS = {
    "yaml": lambda path: read_yaml(path, "edits file"),
    "json": lambda path: read_json(path, "extract"),
    "arrays": lambda path: read_arrays(path, "train"),
    "points": read_positions,
    "seed": lambda path: read_ply(path, "lidar_seed"),
    "splat": read_splat_ply,
    "transforms.json": content_of,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(("make", "what"), [(a_device, "device"), (os.mkdir, "folder")])
def test_readers_of_files_refuse_what_is_none_before_they_open_it(tmp_path, reader, make, what):
    make(tmp_path / "given")
    with pytest.raises((DriveSplatError, OSError), match=f"it is a {what}, not a regular file|is not a file"):
        READERS[reader](tmp_path / "given")


def test_a_drive_json_and_a_sweep_that_are_no_files_are_faults(tmp_path):
    for name in ("drive.json", "sweep.npz", "sweep.ply"):
        a_device(tmp_path / name)
    assert "it is a device" in structure_of(tmp_path / "drive.json")[0][0]
    assert all("it is a device" in str(read_file(tmp_path / name)) for name in ("sweep.npz", "sweep.ply"))


def test_json_that_is_nested_too_deeply_is_refused(tmp_path):
    (tmp_path / "scene.json").write_text("[" * 100_000)
    with pytest.raises(ResultError, match=r"scene\.json: not a readable JSON file .*'extract'"):
        read_json(tmp_path / "scene.json", "extract")


def test_a_regular_file_is_taken_also_by_a_link_and_refused_beyond_its_size(tmp_path):
    (tmp_path / "file").write_bytes(b"x" * 2_000_001)
    (tmp_path / "link").symlink_to("file")
    assert regular_file(tmp_path / "link", 2_000_001).read_bytes() == b"x" * 2_000_001
    with pytest.raises(OSError, match="it has 2 MB, more than 1 MB"):
        regular_file(tmp_path / "file", 1_000_000)
    with pytest.raises(FileNotFoundError):
        regular_file(tmp_path / "absent")
    with pytest.raises(OSError, match="null byte"):
        regular_file("a\0b")
