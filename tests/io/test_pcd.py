"""PCD files of all three kinds, and hostile ones."""

from pathlib import Path

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.mutations import CHANCE, likely, mutate_bytes
from hypothesis import given, settings

from drivesplat.io.pcd import header_of, read_pcd
from drivesplat.readers.drive.sweep_file import columns_sentence, read_file

COLUMNS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("normal", "<f4", (3,)), ("intensity", "u1"), ("ring", "<u2")]
RECORDS = np.zeros(400, dtype=[*COLUMNS, ("t", "<f8")])


def setup_module() -> None:
    random = np.random.default_rng(0)
    for name in ("x", "y", "z"):
        RECORDS[name] = random.uniform(-50.0, 50.0, 400).round(1)
    RECORDS["normal"] = [0.0, 0.0, 1.0]
    RECORDS["intensity"] = random.integers(0, 256, 400)
    RECORDS["ring"] = np.arange(400) % 32
    RECORDS["t"] = 1.7e9 + 1e-6 * np.arange(400)


def lzf(content: bytes) -> bytes:
    """`content` compressed with LZF: runs of a byte as references to the byte before, all else as it is."""
    packed, at, plain = bytearray(), 0, bytearray()

    def flush() -> None:
        for begin in range(0, len(plain), 32):
            piece = plain[begin : begin + 32]
            packed.extend([len(piece) - 1, *piece])
        plain.clear()

    while at < len(content):
        # the same bytes `back` before: overlapping (1) or apart (12)
        run, back = max((same(content, at, back), back) for back in (1, 12) if back <= at) if at else (0, 1)
        if run < 3:
            plain.append(content[at])
            at += 1
            continue
        flush()
        length = min(run, 264) - 2
        packed += bytes([(length << 5)] if length < 7 else [7 << 5, length - 7]) + bytes([back - 1])
        at += length + 2
    flush()
    return bytes(packed)


def same(content: bytes, at: int, back: int) -> int:
    """The number of bytes, at most 264, that are those `back` before."""
    count = 0
    while count < 264 and at + count < len(content) and content[at + count] == content[at + count - back]:
        count += 1
    return count


def pcd(path: Path, data: str, records: np.ndarray = RECORDS, **changes: str) -> Path:
    """A PCD file written here; `changes` replace lines of its header."""
    kinds, names = {"f": "F", "i": "I", "u": "U"}, records.dtype.names
    bases = [records.dtype[name].base for name in names]
    counts = [int(np.prod(records.dtype[name].shape)) for name in names]
    lines = {
        "VERSION": "0.7", "FIELDS": " ".join(names), "SIZE": " ".join(str(base.itemsize) for base in bases),
        "TYPE": " ".join(kinds[base.kind] for base in bases), "COUNT": " ".join(map(str, counts)),
        "WIDTH": str(len(records)), "HEIGHT": "1", "VIEWPOINT": "0 0 0 1 0 0 0", "POINTS": str(len(records)),
        "DATA": data,
    } | changes  # fmt: skip
    header = "# .PCD v0.7 - Point Cloud Data file format\n" + "".join(f"{k} {v}\n" for k, v in lines.items())
    if data == "ascii":
        rows = [" ".join(repr(v.item()) for name in names for v in np.ravel(record[name])) for record in records]
        body = ("\n".join(rows) + "\n").encode()
    elif data == "binary":
        body = records.tobytes()
    else:
        columns = b"".join(np.ascontiguousarray(records[name]).tobytes() for name in names)
        packed = lzf(columns)
        body = np.array([len(packed), len(columns)], dtype="<u4").tobytes() + packed
    path.write_bytes(header.encode() + body)
    return path


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_columns_are_read_from_every_kind_of_data(data, tmp_path):
    path = pcd(tmp_path / "top.pcd", data)
    columns = read_pcd(path)
    assert list(columns) == ["x", "y", "z", "intensity", "ring", "t"]
    for name, values in columns.items():
        np.testing.assert_array_equal(values, RECORDS[name])
    assert data != "binary_compressed" or path.stat().st_size < 0.9 * len(RECORDS.tobytes()), "it is compressed"


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_as_a_sweep_its_intensities_are_between_0_and_1(data, tmp_path):
    path = pcd(tmp_path / "top.PCD", data)
    returns = read_file(path)
    np.testing.assert_array_equal(returns.points[:, 2], RECORDS["z"].astype(np.float64))
    np.testing.assert_array_equal(returns.rings, RECORDS["ring"])
    np.testing.assert_allclose(returns.intensity, RECORDS["intensity"] / 255.0, atol=1e-6)
    assert returns.offsets_s is None
    assert columns_sentence(path) == ("has x, y, z, intensity, ring, whose intensities are divided by 255; not used: t")


def test_without_counts_and_points_the_width_says_how_many(tmp_path):
    few = RECORDS[["x", "y", "z"]][:6]
    path = pcd(tmp_path / "a.pcd", "ascii", few, WIDTH="3", HEIGHT="2", VIEWPOINT="1 2 3 1 0 0 0")
    text = path.read_text()
    path.write_text("".join(line for line in text.splitlines(True) if not line.startswith(("COUNT", "POINTS"))))
    assert len(read_pcd(path)["x"]) == 6 and header_of(path).moved
    assert columns_sentence(path) == "has x, y, z; not used: the VIEWPOINT"


FAULTS = {
    "unknown data": ({"DATA": "text"}, "its DATA is 'text'"),
    "another number of types": ({"TYPE": "F F F"}, "do not have the same number of entries"),
    "a type of 3 bytes": ({"SIZE": "3 4 4 4 1 2 8"}, "has the type F of 3 bytes"),
    "more points than bytes": ({"POINTS": "9999999999", "WIDTH": "9999999999"}, "points.* take"),
    "width without points": ({"WIDTH": "7"}, "its header has 400 points, and 7 x 1 of them"),
    "a negative count": ({"COUNT": "1 1 1 -3 1 1 1"}, "COUNT of its header is '-3'"),
    "a viewpoint of words": ({"VIEWPOINT": "a b c"}, "could not convert"),
    "two columns of one name": ({"FIELDS": "x y z normal z ring t"}, "two of its columns have one name"),
}


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("fault", FAULTS)
def test_headers_that_cannot_be_are_refused(fault, data, tmp_path):
    changes, words = FAULTS[fault]
    path = pcd(tmp_path / "top.pcd", data, **changes)
    with pytest.raises(ValueError, match=words):
        read_pcd(path)
    said = str(read_file(path))
    assert said.startswith("is corrupt (") and "\n" not in said


def test_a_header_without_end_is_refused_after_its_first_bytes(tmp_path):
    path = tmp_path / "top.pcd"
    path.write_bytes(b"# .PCD\n" + b"#" * 5_000_000)
    assert "no line DATA within its first 20000 bytes" in str(read_file(path))


@settings(max_examples=200)
@given(random=CHANCE)
def test_200_damaged_files_give_columns_of_one_length_or_a_sentence(tmp_path, random):
    path = pcd(tmp_path / "top.pcd", random.choice(["ascii", "binary", "binary_compressed"]), RECORDS[:60])
    if likely(random, 5):
        done = mutate_bytes(random, path)
    else:  # damage to the header alone
        content = bytearray(path.read_bytes())
        for _ in range(random.choice([1, 3])):
            content[random.randrange(content.find(b"DATA") + 20)] = random.choice(b"0123456789 \nFIU-.x")
        path.write_bytes(content)
        done = "header"
    found = read_file(path)
    if isinstance(found, str):
        assert "\n" not in found and 8 < len(found) < 300, done
    else:
        assert np.isfinite(found.points).all() and len(found.points) <= 60, done


def test_a_file_of_another_program_is_read():
    path = REPOSITORY.parent / "shared/data/odd-inputs/ascii.pcd"
    if not path.is_file():
        pytest.skip(f"no PCD file of another program at {path}")
    assert columns_sentence(path) == "has x, y, z"
    points = read_file(path).points
    np.testing.assert_allclose(points, np.loadtxt(path, skiprows=11), atol=1e-6)
