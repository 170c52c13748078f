"""Files of arrays: round trips, and refusal of all other content."""

import io
import json
import pickle
import random
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from drivesplat.errors import ResultError
from drivesplat.io import checkpoint_file
from drivesplat.io.array_file import read_arrays, write_arrays

CONTENT = {
    "actors": [{"id": "a", "points": np.arange(6, dtype=np.float32).reshape(2, 3), "runs": [[0, 2]]}, {"id": "ö"}],
    "state": {0: {"step": np.array(3.0)}, "betas": (0.9, 0.999)}, "none": None, "flags": [True, False], "tiny": 5e-324,
    "empty": np.zeros((0, 3)), "turned": np.asfortranarray(np.arange(6).reshape(2, 3)), "$odd": np.array([True, False]),
}  # fmt: skip


def same(a: Any, b: Any) -> bool:
    """Whether both are equal; arrays bit for bit and with the same memory order."""
    if isinstance(a, np.ndarray):
        order = a.flags.c_contiguous == b.flags.c_contiguous
        return (a.dtype, a.shape, a.tobytes(), order) == (b.dtype, b.shape, b.tobytes(), True)
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


def test_content_survives_a_round_trip(tmp_path):
    write_arrays(tmp_path / "a.npz", CONTENT)
    again = read_arrays(tmp_path / "a.npz", "actors")
    assert same(again, CONTENT)
    again["actors"][0]["points"][0, 0] = 7.0  # arrays can be written to


def test_numpy_opens_the_file_without_pickle(tmp_path):
    write_arrays(tmp_path / "a.npz", {"actors": CONTENT["actors"]})
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["actors/0/points"], CONTENT["actors"][0]["points"])
        assert json.loads(arrays["content"].tobytes())["actors"][1] == {"id": "ö"}


def test_equal_content_makes_equal_files(tmp_path):
    for name in ("a.npz", "b.npz"):
        write_arrays(tmp_path / name, CONTENT)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_tensors_are_read_as_tensors(tmp_path):
    content = {
        "means": torch.randn(4, 3, requires_grad=True),
        "step": torch.tensor(5.0),
        "random": torch.get_rng_state(),
    }
    checkpoint_file.save(tmp_path / "a.npz", content)
    again = checkpoint_file.load(tmp_path / "a.npz", "train")
    assert all(torch.equal(again[name], content[name]) and again[name].dtype == content[name].dtype for name in content)


@pytest.mark.parametrize(
    "value",
    [np.array([None]), np.array(["text"]), np.array([1j]), np.zeros(2, "f4,f4"), np.float64(1), {1, 2}, b"x", 1j],
)
def test_writing_anything_but_numbers_and_plain_data_is_refused(tmp_path, value):
    with pytest.raises(TypeError, match="not plain data"):
        write_arrays(tmp_path / "a.npz", {"value": [value]})
    assert not list(tmp_path.iterdir())


def test_a_flipped_bit_is_refused_or_without_effect(tmp_path):
    """Archive headers contain bytes without effect, such as the modification time."""
    path, chance = tmp_path / "a.npz", random.Random(0)
    write_arrays(path, {**CONTENT, "many": np.random.default_rng(0).normal(size=500)})
    whole, expected, refused = path.read_bytes(), read_arrays(path, "actors"), 0
    for _ in range(100):
        content = bytearray(whole)
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        path.write_bytes(content)
        try:
            assert same(read_arrays(path, "actors"), expected)
        except ResultError as error:
            assert str(error).startswith(f"{path}: not a file of arrays") and "the rule 'actors' rebuilds it" in str(
                error
            )
            refused += 1
    assert refused > 80


def test_every_flipped_bit_of_an_array_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    write_arrays(path, {"values": np.arange(8.0)})
    whole = path.read_bytes()
    start = whole.index(np.arange(8.0).tobytes())
    for bit in range(8 * 64):
        content = bytearray(whole)
        content[start + bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        with pytest.raises(ResultError, match=r"Bad CRC-32 for file 'values\.npy'"):
            read_arrays(path, "actors")


def test_a_file_truncated_anywhere_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    write_arrays(path, {"values": np.arange(4)})
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(ResultError, match=r"a\.npz: not a file of arrays.*'actors'"):
            read_arrays(path, "actors")


def archive(path: Path, compression: int = zipfile.ZIP_STORED, **members: bytes) -> None:
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)


def npy(array: np.ndarray, **header: Any) -> bytes:
    """An array in numpy's format; `header` replaces its header."""
    file = io.BytesIO()
    fields = {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape, **header}
    np.lib.format.write_array_header_1_0(file, fields)
    return file.getvalue() + array.tobytes()


def plain(value: Any) -> bytes:
    return npy(np.frombuffer(json.dumps(value).encode(), np.uint8))


REFERS = plain({"a": {"$array": "a"}})
EIGHT = np.frombuffer(b"AAAAAAAA", "f8")


@pytest.mark.parametrize(
    "members",
    [
        {"content": REFERS},
        {"a": npy(EIGHT)},
        {"content": plain({}), "a": npy(EIGHT)},
        {"content": plain([{"$array": "a"}]), "a": npy(EIGHT)},
        {"content": plain({"a": {"$array": "a"}, "b": {"$array": "a"}}), "a": npy(EIGHT)},
        {"content": REFERS, "a": npy(EIGHT, descr="|O")},
        {"content": REFERS, "a": npy(EIGHT, descr="<U2")},
        {"content": REFERS, "a": npy(EIGHT, descr=[("x", "<f8")])},
        {"content": REFERS, "a": npy(EIGHT, shape=(2**40,))},
        {"content": REFERS, "a": npy(EIGHT, shape=(-1, -1))},
        {"content": REFERS, "a": npy(EIGHT, shape=(1,) * 30)},
        {"content": REFERS, "a": pickle.dumps([1])},
        {"content": npy(np.frombuffer(b"[" * 100_000, np.uint8))},
        {"content": npy(np.frombuffer(b"\xff{}", np.uint8))},
    ],
)
def test_a_forged_archive_is_refused(tmp_path, members):
    archive(tmp_path / "a.npz", **members)
    with pytest.raises(ResultError, match=r"a\.npz: not a file of arrays.*'actors'"):
        read_arrays(tmp_path / "a.npz", "actors")


def test_a_compressed_archive_is_refused_without_decompression(tmp_path):
    """A few compressed bytes could expand to gigabytes."""
    archive(tmp_path / "a.npz", zipfile.ZIP_DEFLATED, content=REFERS, a=npy(np.zeros(100_000)))
    with pytest.raises(ResultError, match="larger than the file"):
        read_arrays(tmp_path / "a.npz", "actors")
