"""Pickles of plain data: nothing in a file is executed, and no file crashes or hangs its reader."""

import builtins
import collections
import enum
import os
import pickle
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.patience import PATIENCE_S

from drivesplat.errors import ResultError
from drivesplat.io.plain_pickle import MAX_DEPTH, MAX_DIMENSIONS, read_plain_pickle, write_plain_pickle


def test_a_missing_pickle_is_named_with_its_rule(tmp_path):
    with pytest.raises(ResultError, match=r"absent\.pkl.*'parser'"):
        read_plain_pickle(tmp_path / "absent.pkl", rule="parser")


def assert_same(a, b) -> None:
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and a.shape == b.shape
        assert a.tobytes() == b.tobytes()
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a == b


@pytest.mark.parametrize(
    "value",
    [
        {"Ks": np.eye(3), "timestamps": np.array([2**60 + 1]), "points": np.zeros((0, 3), np.float32)},
        {"splits": {"train": np.arange(3), "held_out": []}, "size": (640, 360), "none": None, "flag": True, 4: b"\0"},
        [np.array([True, False]), np.array(["a", "bc"]), np.array(1.5), np.arange(6).reshape(2, 3).T],
        [np.asfortranarray(np.eye(3)[:2]), np.arange(3, dtype=">u2"), np.array([b"ab", b""]), np.float16([1.5])],
        {"a": {"b": [(1,), (2, 3), (4, 5, 6), (7, 8, 9, 10), ()]}, "long": [2**70, -(2**70)], "float": 0.1},
    ],
)
def test_a_plain_pickle_survives_a_round_trip(tmp_path, value):
    write_plain_pickle(tmp_path / "value.pkl", value)
    assert_same(read_plain_pickle(tmp_path / "value.pkl", rule="parser"), value)


class Anything:
    """A class of our own."""


class Colour(enum.IntEnum):
    RED = 1


class Text(str):
    """More than a string."""

    __slots__ = ()


Pair = collections.namedtuple("Pair", "a b")


@pytest.mark.parametrize(
    "value",
    [
        np.array([None, 1], dtype=object),
        np.array([("a", 1)], dtype=[("x", object), ("y", "i4")]),
        np.array([(1, 2.0)], dtype=[("x", "i4"), ("y", "f8")]),
        np.array([1j]),
        np.array(["2020-01-01"], dtype="M8[D]"),
        np.array([b"ab"], dtype="V2"),
        np.zeros((1,) * (MAX_DIMENSIONS + 1)),
        {(1, 2): 3},
        Anything(),
        Anything,
        len,
        {1, 2},
        np.float64(1.0),
        np.int64(1),
        np.dtype("f8"),
        {Anything(): 1},
        [[(Anything(),)]],
        1j,
        collections.OrderedDict(a=1),
        collections.defaultdict(list),
        Pair(1, 2),
        Colour.RED,
        Text("text"),
        np.ma.masked_array([1.0, 2.0]),
    ],
    ids=lambda value: type(value).__name__,
)
def test_writing_anything_but_plain_data_is_refused(tmp_path, value):
    """The writer refuses whatever the reader refuses, so that every written result can be read."""
    with pytest.raises(TypeError):
        write_plain_pickle(tmp_path / "value.pkl", {"value": value})
    assert not list(tmp_path.iterdir())


class RunsACommand:
    def __init__(self, marker):
        self.command = f"touch '{marker}'"

    def __reduce__(self):
        return os.system, (self.command,)


class Opens:
    def __init__(self, marker):
        self.marker = str(marker)

    def __reduce__(self):
        return builtins.open, (self.marker, "w")


class Evaluates:
    def __init__(self, marker):
        self.code = f"open({str(marker)!r}, 'w').close()"

    def __reduce__(self):
        return builtins.eval, (self.code,)


@pytest.mark.parametrize("attack", [RunsACommand, Opens, Evaluates])
@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_a_pickle_with_code_is_refused_and_not_executed(tmp_path, attack, protocol):
    marker = tmp_path / "executed"
    content = pickle.dumps({"Ks": np.eye(3), "attack": attack(marker)}, protocol=protocol)
    pickle.loads(pickle.dumps(attack(marker)))
    assert marker.exists(), "the attack itself must work for this test to mean anything"
    marker.unlink()
    (tmp_path / "parser.pkl").write_bytes(content)
    with pytest.raises(ResultError, match=r"parser\.pkl.*'parser'"):
        read_plain_pickle(tmp_path / "parser.pkl", rule="parser")
    assert not marker.exists()


def test_code_inside_an_object_array_is_refused_and_not_executed(tmp_path):
    marker = tmp_path / "executed"
    array = np.empty(1, dtype=object)
    array[0] = RunsACommand(marker)
    (tmp_path / "parser.pkl").write_bytes(pickle.dumps(array))
    with pytest.raises(ResultError, match="'parser'"):
        read_plain_pickle(tmp_path / "parser.pkl", rule="parser")
    assert not marker.exists()


@pytest.mark.parametrize("value", [np.array([None, 1]), collections.OrderedDict(a=1), Pair(1, 2), {1, 2}, 1j])
def test_reading_anything_but_plain_data_is_refused(tmp_path, value):
    (tmp_path / "parser.pkl").write_bytes(pickle.dumps({"value": value}))
    with pytest.raises(ResultError, match=r"parser\.pkl.*'parser'"):
        read_plain_pickle(tmp_path / "parser.pkl", rule="parser")


def test_a_pickle_truncated_anywhere_is_refused_naming_file_and_rule(tmp_path):
    write_plain_pickle(tmp_path / "whole.pkl", {"Ks": np.eye(3), "names": ["a", "b"]})
    whole = (tmp_path / "whole.pkl").read_bytes()
    for length in range(len(whole)):
        (tmp_path / "cut.pkl").write_bytes(whole[:length])
        with pytest.raises(ResultError, match=r"cut\.pkl.*'parser'"):
            read_plain_pickle(tmp_path / "cut.pkl", rule="parser")


@pytest.mark.parametrize("content", [b"", b"ply\nformat", b"\x89PNG\r\n\x1a\n", b"PK\x03\x04", b"\x80\xff."])
def test_a_foreign_pickle_is_refused_naming_file_and_rule(tmp_path, content):
    (tmp_path / "foreign.pkl").write_bytes(content)
    with pytest.raises(ResultError, match=r"foreign\.pkl.*'parser'"):
        read_plain_pickle(tmp_path / "foreign.pkl", rule="parser")


# ---- forged files

DTYPE = b"cnumpy\ndtype\n"
RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
"""An array that has no state yet."""


def plain(value: object) -> bytes:
    """The opcodes that put a value onto the stack, without those that begin and end a pickle."""
    return pickle.dumps(value, protocol=3)[2:-1]


def forged_array(code: str, dtype_state: tuple, shape: tuple, content: bytes, fortran: bool = False) -> bytes:
    """A pickle of an array whose dtype is built from any state."""
    dtype = DTYPE + plain((code, False, True)) + b"R" + plain(dtype_state) + b"b"
    state = b"(" + plain(1) + plain(shape) + dtype + plain(fortran) + plain(content) + b"t"
    return b"\x80\x03" + RECONSTRUCT + state + b"b."


def nested(depth: int) -> bytes:
    return b"\x80\x03)" + b"\x85" * depth + b"."


def aliases(levels: int) -> bytes:
    """A list of 2^levels lists, by reference."""
    doubled = (b"q%c](h%ch%ce" % (i, i, i) for i in range(levels))
    return b"\x80\x03]" + b"".join(doubled) + b"."


NORMAL = (3, "<", None, None, None, -1, -1, 0)
EIGHT = (0x4141414141414141).to_bytes(8, "little")
ATTACKS = {
    "pointers behind a dtype that denies holding objects": forged_array(
        "O8", (3, "|", None, None, None, -1, -1, 0), (1,), EIGHT
    ),
    "a number that becomes a pointer": forged_array("f8", (3, "|", None, None, None, -1, -1, 63), (1,), EIGHT).replace(
        plain("f8"), plain("O8")
    ),
    "fields beyond the item": forged_array("V8", (3, "|", None, ("x",), {"x": ("f8", 2**40)}, 8, 1, 0), (1,), EIGHT),
    "a subarray": forged_array("V8", (3, "|", (("f8",), (2**40,)), None, None, 8, 1, 0), (1,), EIGHT),
    "aliases": aliases(45),
    "aliases where a dtype is named": b"\x80\x03" + DTYPE + aliases(45)[2:-1] + b"\x85R.",
    "aliases as the shape": forged_array("f8", NORMAL, (1,), EIGHT).replace(plain((1,)), aliases(45)[2:-1], 1),
    "aliases as a key": b"\x80\x03}" + aliases(45)[2:-1] + b"Ns.",
    "a deep tuple": nested(1_000_000),
    "a deep key": b"\x80\x03}" + nested(1_000_000)[2:-1] + b"Ns.",
    "a list in itself": b"\x80\x03]q\x00h\x00a.",
    "more elements than bytes": forged_array("f8", NORMAL, (2**40,), EIGHT),
    "fewer elements than bytes": forged_array("f8", NORMAL, (0,), EIGHT),
    "a size that overflows": forged_array("f8", NORMAL, (2**62, 4, 2), EIGHT),
    "a negative size": forged_array("f8", NORMAL, (-1, -1), EIGHT),
    "a size that is no number": forged_array("f8", NORMAL, ("1",), EIGHT),
    "elements of no bytes": forged_array("U0", (3, "<", None, None, None, 0, 4, 8), (2**62,), b""),
    "an item size of the file's": forged_array("U2", (3, "<", None, None, None, 2**30, 4, 8), (1,), EIGHT),
    "no characters": forged_array("U2", (3, "<", None, None, None, 8, 4, 8), (1,), b"\xff" * 8),
    "no truth values": forged_array("b1", (3, "|", None, None, None, -1, -1, 0), (8,), b"\xff" * 8),
    "dates": forged_array("M8", (4, "<", None, None, None, -1, -1, 0, ({}, (b"D", 1, 1, 1))), (1,), EIGHT),
    "an order of the file's": forged_array("f8", (3, "f8,<", None, None, None, -1, -1, 0), (1,), EIGHT),
    "a far place in the memo": b"\x80\x03Nr\xff\xff\xff\x7f" + b"j\xff\xff\xff\x6f.",
    "a huge buffer": b"\x80\x05\x96" + (2**40).to_bytes(8, "little") + b".",
    "a huge text": b"\x80\x04\x8d" + (2**62).to_bytes(8, "little") + b".",
    "a state for a list": b"\x80\x03]}b.",
    "a call of a number": b"\x80\x03K\x01)R.",
    "an array without a state": b"\x80\x03" + RECONSTRUCT + b".",
    "a dtype alone": b"\x80\x03" + DTYPE + plain(("f8", False, True)) + b"R.",
    "a function alone": b"\x80\x03" + DTYPE + b".",
    "a persistent object": b"\x80\x03Nq\x00Q.",
    "an object of a class": b"\x80\x03" + DTYPE + b")\x81.",
    "an extension": b"\x80\x03\x82\x01.",
    "nothing": b"\x80\x03.",
    "two values": b"\x80\x03NN.",
    "more after its end": b"\x80\x03N.N",
    "an end too early": b"\x80\x03N0.",
}


def mutated(content: bytes, seed: int) -> bytes:
    """A pickle with a few bytes changed, moved, repeated or left out."""
    chance, changed = random.Random(seed), bytearray(content)
    for _ in range(chance.randint(1, 4)):
        start, length = chance.randrange(len(changed)), chance.randint(1, 12)
        piece = bytes(changed[start : start + length])
        match chance.randrange(5):
            case 0:
                changed[start] ^= 1 << chance.randrange(8)
            case 1:
                changed[start] = chance.choice(b"()]}.0NKRbaesutq\x85\x86\x87\x93\x94")
            case 2:
                del changed[start : start + length]
            case 3:
                changed[start:start] = piece * chance.choice([1, 2, 1000])
            case 4:
                place = chance.randrange(len(changed))
                changed[place : place + length] = piece
    return bytes(changed)


READER = """
import sys
from pathlib import Path
from drivesplat.errors import ResultError
from drivesplat.io.plain_pickle import read_plain_pickle, write_plain_pickle
for path in sorted(Path(sys.argv[1]).iterdir()):
    try:
        write_plain_pickle(Path(sys.argv[2]), read_plain_pickle(path, "parser"))
        print(path.name, "plain")
    except ResultError as error:
        print(path.name, "refused", str(error).startswith(f"{path}: not a pickle of plain data and arrays ("))
"""


def read_apart(files: dict[str, bytes], folder: Path) -> dict[str, str]:
    """Reads files in a subprocess limited to 2 GB, and returns the outcome for each."""
    (folder / "forged").mkdir()
    for name, content in files.items():
        (folder / "forged" / name).write_bytes(content)
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30)){READER}"
    command = [sys.executable, "-c", limited, str(folder / "forged"), str(folder / "again.pkl")]
    done = subprocess.run(
        command,
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    return dict(line.split(" ", 1) for line in done.stdout.splitlines())


def test_a_forged_pickle_is_refused_without_a_crash(tmp_path):
    names = {f"{i:03}": name for i, name in enumerate(ATTACKS)}
    found = read_apart({number: ATTACKS[name] for number, name in names.items()}, tmp_path)
    assert {names[number]: outcome for number, outcome in found.items()} == dict.fromkeys(ATTACKS, "refused True")


def test_100_mutated_pickles_are_plain_or_refused_without_a_crash(tmp_path):
    """Content that can be read can also be written, so it is plain data."""
    record = {
        "Ks": np.eye(3), "names": ["a.jpg", "b.jpg"], "times": np.array([1, 2]), "seen": np.array([True]), "none": None,
        "camera": np.array(["FRONT", "é"]), "splits": {"train": np.arange(3)}, "scale": 1.5, "pair": (1, b"x", -7),
    }  # fmt: skip
    whole = [pickle.dumps(record, protocol=protocol) for protocol in (3, 4, 5)]
    found = read_apart({f"{i:03}": mutated(whole[i % 3], i) for i in range(100)}, tmp_path)
    assert len(found) == 100 and set(found.values()) <= {"plain", "refused True"}
    assert sum(outcome == "refused True" for outcome in found.values()) > 50


def test_data_may_be_nested_to_the_documented_depth(tmp_path):
    value: list = []
    for _ in range(MAX_DEPTH):
        value = [value]
    write_plain_pickle(tmp_path / "value.pkl", value)
    assert read_plain_pickle(tmp_path / "value.pkl", "parser") == value
    with pytest.raises(TypeError, match="levels"):
        write_plain_pickle(tmp_path / "value.pkl", [value])


@pytest.mark.parametrize("core", [b"numpy.core", b"numpy._core"])
def test_arrays_of_numpy_1_and_2_are_read(tmp_path, core):
    """The two versions name the package of arrays differently; protocol 3 stores the name as text."""
    content = pickle.dumps({"a": np.arange(6.0).reshape(2, 3)}, protocol=3)
    (tmp_path / "value.pkl").write_bytes(content.replace(b"numpy._core", b"numpy.core").replace(b"numpy.core", core))
    again = read_plain_pickle(tmp_path / "value.pkl", "parser")
    np.testing.assert_array_equal(again["a"], np.arange(6.0).reshape(2, 3))


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_arrays_of_every_protocol_are_writable(tmp_path, protocol):
    (tmp_path / "value.pkl").write_bytes(pickle.dumps([np.arange(3), np.zeros((0, 3))], protocol=protocol))
    first, empty = read_plain_pickle(tmp_path / "value.pkl", "parser")
    first += 1
    assert first.tolist() == [1, 2, 3] and empty.shape == (0, 3)
