"""Files that a user names: pipes, devices, folders and circles of links are refused in words before they are opened."""

import os
import socket
from pathlib import Path

import pytest

from drivesplat.io.regular_file import regular_file


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
