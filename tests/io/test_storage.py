"""Files are complete or absent and hold plain data only; errors name the file and the rule that rebuilds it."""

import builtins
import errno
import os
import time
from contextlib import nullcontext

import pytest

from drivesplat.errors import ResultError
from drivesplat.io.storage import (
    ABANDONED_SECONDS,
    atomic_write,
    canonical_json,
    read_json,
    write_json,
)


def write(path, content: bytes) -> None:
    with atomic_write(path) as file:
        file.write(content)


def files_below(folder) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def raiser(number: int):
    def raises(*_, **__):
        raise OSError(number, os.strerror(number))

    return raises


def test_a_written_file_is_complete_and_leaves_no_partial_file(tmp_path):
    write(tmp_path / "new folder" / "result.bin", b"content")
    assert (tmp_path / "new folder" / "result.bin").read_bytes() == b"content"
    assert files_below(tmp_path) == {"new folder/result.bin"}


def test_the_target_does_not_exist_while_it_is_being_written(tmp_path):
    target = tmp_path / "result.bin"
    with atomic_write(target) as file:
        file.write(b"half")
        file.flush()
        assert not target.exists()
    assert target.read_bytes() == b"half"


def test_a_crash_while_writing_leaves_the_old_file_and_no_partial_one(tmp_path):
    write(tmp_path / "result.bin", b"old")
    with pytest.raises(ZeroDivisionError), atomic_write(tmp_path / "result.bin") as file:
        file.write(b"new, but only ha")
        raise ZeroDivisionError
    assert (tmp_path / "result.bin").read_bytes() == b"old"
    assert files_below(tmp_path) == {"result.bin"}


@pytest.mark.parametrize("whole", [True, False])
def test_partial_files_of_killed_writers_are_removed_after_an_hour(tmp_path, whole):
    """Only those of the same target, whether the new write succeeds or not."""
    left = {
        ".result.4711.partial.bin": ABANDONED_SECONDS + 60,
        ".result.8.partial.bin": 10 * ABANDONED_SECONDS,
        ".result.4712.partial.bin": ABANDONED_SECONDS - 60,
        ".result.4713.partial.bin": 0,
        ".result.4714.partial.json": 2 * ABANDONED_SECONDS,
        ".results.4715.partial.bin": 2 * ABANDONED_SECONDS,
        ".result.bin": 2 * ABANDONED_SECONDS,
        "result.4711.partial.bin": 2 * ABANDONED_SECONDS,
        ".result.mine.partial.bin": 2 * ABANDONED_SECONDS,
    }
    for name, age in left.items():
        (tmp_path / name).write_bytes(b"half")
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    with nullcontext() if whole else pytest.raises(ZeroDivisionError), atomic_write(tmp_path / "result.bin") as file:
        file.write(b"whole")
        file.write(b"" if whole else bytes(1 // 0))
    gone = {".result.4711.partial.bin", ".result.8.partial.bin"}
    assert files_below(tmp_path) == left.keys() - gone | ({"result.bin"} if whole else set())


def test_a_full_disk_is_reported_with_the_file_name_and_keeps_the_old_file(tmp_path, monkeypatch):
    write(tmp_path / "result.bin", b"old")
    monkeypatch.setattr(os, "fsync", raiser(errno.ENOSPC))
    with pytest.raises(ResultError) as failure:
        write(tmp_path / "result.bin", b"new")
    assert str(tmp_path / "result.bin") in str(failure.value)
    assert os.strerror(errno.ENOSPC) in str(failure.value)
    assert (tmp_path / "result.bin").read_bytes() == b"old"
    assert files_below(tmp_path) == {"result.bin"}


def test_a_read_only_file_system_is_reported_with_the_file_name(tmp_path, monkeypatch):
    """Every change fails there, including removal of a file that does not exist."""
    opened = builtins.open

    def open_read_only(file, mode="r", *args, **kwargs):
        return opened(file, mode, *args, **kwargs) if "r" in mode else raiser(errno.EROFS)()

    for name in ("unlink", "remove", "rename", "replace"):
        monkeypatch.setattr(os, name, raiser(errno.EROFS))
    monkeypatch.setattr(builtins, "open", open_read_only)
    with pytest.raises(ResultError) as failure:
        write(tmp_path / "result.bin", b"new")
    assert str(tmp_path / "result.bin") in str(failure.value)
    assert os.strerror(errno.EROFS) in str(failure.value)


def test_a_file_in_place_of_a_folder_is_reported_with_its_name(tmp_path):
    (tmp_path / "results").write_text("a file, no folder")
    with pytest.raises(ResultError, match=r"results/0061/scene\.json"):
        write(tmp_path / "results" / "0061" / "scene.json", b"{}")
    with pytest.raises(ResultError, match=r"results/scene\.json"):
        write(tmp_path / "results" / "scene.json", b"{}")


def test_canonical_json_depends_on_every_value():
    assert canonical_json({"a": [1, 2]}) != canonical_json({"a": [2, 1]})
    assert canonical_json({"a": 1, "b": 2}) != canonical_json({"a": 2, "b": 1})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_json_with_numbers_that_are_not_finite_is_refused(tmp_path, value):
    with pytest.raises(ValueError):
        canonical_json({"psnr": value})
    with pytest.raises(ValueError):
        write_json(tmp_path / "metrics.json", {"psnr": value})
    assert files_below(tmp_path) == set()


def test_json_survives_a_round_trip_bit_for_bit(tmp_path):
    value = {"numbers": [0.1, 1 / 3, 1e-300, 2**53 + 1], "text": "Zürich", "none": None, "nested": {"a": [True]}}
    write_json(tmp_path / "value.json", value)
    assert read_json(tmp_path / "value.json", rule="extract") == value


def test_json_truncated_anywhere_is_refused_naming_file_and_rule(tmp_path):
    write_json(tmp_path / "whole.json", {"schema": 1, "frames": [{"token": "ä"}, 2.5]})
    whole = (tmp_path / "whole.json").read_bytes()
    for length in range(len(whole.rstrip())):
        (tmp_path / "cut.json").write_bytes(whole[:length])
        with pytest.raises(ResultError, match=r"cut\.json.*'extract'"):
            read_json(tmp_path / "cut.json", rule="extract")


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xfe\x00", b"{} {}", b"not json"])
def test_foreign_json_is_refused_naming_file_and_rule(tmp_path, content):
    (tmp_path / "foreign.json").write_bytes(content)
    with pytest.raises(ResultError, match=r"foreign\.json.*'parser'"):
        read_json(tmp_path / "foreign.json", rule="parser")


def test_a_missing_result_is_named_with_its_rule(tmp_path):
    with pytest.raises(ResultError, match=r"absent\.json.*'extract'"):
        read_json(tmp_path / "absent.json", rule="extract")
