"""Tables that pandas has pickled, such as those of PandaSet, read without executing what the file names.

A pickle is a program: its unpickler imports and calls what the file names, and numpy's `__setstate__` trusts the layout
that the file states. Here Python's unpickler executes only the opcodes that a table of numbers and texts needs, and
stand-ins take the place of the few classes of pandas and numpy; a file that names anything else is refused. Arrays are
views of the bytes in the file after dtype and shape have been checked. pandas 0.24 to 2.3 are known.

The unpickler is the one written in Python, `pickle._Unpickler`. The one in C has no table of opcodes to restrict, and
allocates memory for places and sizes that a file only states.
"""

import gzip
import io
import math
import pickle
import re
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError

MAX_BYTES = 1 << 29
"""Of an unpacked file."""
MAX_OPCODES = 4_000_000
MAX_DIMENSIONS = 8
SCALARS = (str, int, float, bool, type(None))
_CODE = re.compile(r"O8|[biufSU][1-9][0-9]{0,8}")
_OPCODES = (
    "PROTO", "FRAME", "STOP", "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "LONG4",
    "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "MARK",
    "MEMOIZE", "BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET", "GLOBAL", "STACK_GLOBAL", "EMPTY_LIST", "EMPTY_TUPLE",
    "TUPLE1", "TUPLE2", "TUPLE3", "TUPLE", "APPEND", "APPENDS", "SETITEM", "SETITEMS", "REDUCE", "NEWOBJ",
)  # fmt: skip
"""The opcodes that are executed as usual, by their names in `pickle`."""


def read_table(path: Path) -> dict[str, np.ndarray]:
    """The columns (n,) of a pickled table, .pkl or .pkl.gz, by their names. Raises DatasetError naming the file if it
    is none."""
    try:
        if not path.is_file():
            raise FileNotFoundError(f"there is no file {path.name}")
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES} bytes")
        program = _Unpickler(io.BytesIO(content))
        frame = program.load()
        if program.stack or program.read(1):
            raise ValueError("something follows its end")
        if type(frame) is not _Frame:
            raise ValueError(f"it holds a {type(frame).__name__}")
        return frame.columns()
    except Exception as error:  # a forged program fails in many ways: every one means "no table"
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise DatasetError(f"{path} cannot be read as a table of pandas ({reason})") from error


class _Dtype:
    """A dtype under construction: `code` as in 'f8', or 'O8' for objects."""

    def __init__(self, code: str, align: int, copy: int):
        if not _CODE.fullmatch(code) or (align, copy) != (False, True):
            raise pickle.UnpicklingError("an array has another dtype than numbers or text")
        self.code, self.dtype = code, None

    def __setstate__(self, state: tuple) -> None:
        version, order, *fields, size, _, _ = state
        dtype = np.dtype(order + self.code)
        if (version, *fields) != (3, None, None, None) or order not in "<>|" or size not in (-1, dtype.itemsize):
            raise pickle.UnpicklingError("an array has another layout than its dtype")
        self.dtype = dtype


class _Array:
    """An array under construction, in place of the result of numpy's `_reconstruct`: `view` of the file's content, or
    scalars of one of objects."""

    view: np.ndarray | None = None

    def __init__(self, kind: type, shape: tuple[int, ...], code: bytes):
        if (kind, shape, code) != (type(self), (0,), b"b"):
            raise pickle.UnpicklingError("it calls what no table needs")

    def __setstate__(self, state: tuple) -> None:
        version, shape, dtype, fortran, content = state
        order = "F" if fortran else "C"
        if version != 1:
            raise pickle.UnpicklingError("an array has an unknown version")
        if isinstance(dtype, _Dtype) and dtype.code == "O8":
            if type(content) is not list or any(type(value) not in SCALARS for value in content):
                raise pickle.UnpicklingError("an array of objects has more than texts and numbers")
            values = np.empty(len(content), dtype=object)
            values[:] = content
            self.view = values.reshape(shape, order=order)
        else:
            self._look_at(content, dtype, shape, order)

    def _look_at(self, content: bytes, dtype: _Dtype, shape: tuple[int, ...], order: str) -> None:
        """Makes `content` the elements. Raises UnpicklingError where it does not fit."""
        kind = dtype.dtype if isinstance(dtype, _Dtype) else None
        if kind is None or not all(type(n) is int and n >= 0 for n in shape) or len(shape) > MAX_DIMENSIONS:
            raise pickle.UnpicklingError("an array has no dtype or no shape")
        if type(content) is not bytes or math.prod(shape) * kind.itemsize != len(content):
            raise pickle.UnpicklingError("an array has another number of bytes than its shape and dtype")
        self.view = np.ndarray(shape, kind, content, order=order)
        codes, limit = {"b": ("u1", 1), "U": (f"{kind.byteorder}u4", sys.maxunicode)}.get(kind.kind, (None, None))
        if codes and self.view.size and (np.frombuffer(content, codes) > limit).any():
            raise pickle.UnpicklingError("an array has elements that are no truth values or characters")


class _Buffer(_Array):
    """An array in place of the result of numpy's `_frombuffer`."""

    def __init__(self, content: bytes, dtype: _Dtype, shape: tuple[int, ...], order: str):
        if isinstance(dtype, _Dtype) and dtype.code == "O8":
            raise pickle.UnpicklingError("an array of objects has no bytes")
        self._look_at(content, dtype, shape, order)


class _Manager:
    """The columns of a table: `blocks` of values (k, n) with their places among the columns, and `axes`."""

    def __init__(self, blocks: tuple = (), axes: tuple = ()):
        self.blocks, self.axes = blocks, axes

    def __setstate__(self, state: tuple) -> None:
        values = state[3]["0.14.1"]
        self.__init__([(block["values"], block["mgr_locs"]) for block in values["blocks"]], values["axes"])


class _Frame:
    """A table under construction."""

    manager: _Manager | None = None

    def __setstate__(self, state: dict) -> None:
        self.manager = state["_mgr"] if "_mgr" in state else state["_data"]

    def columns(self) -> dict[str, np.ndarray]:
        if type(self.manager) is not _Manager:
            raise ValueError("it has no columns")
        names = _values(self.manager.axes[0]).tolist()
        found: dict[str, np.ndarray] = {}
        for values, places in self.manager.blocks:
            rows = np.atleast_2d(_values(values))
            numbers = range(len(names))[places] if type(places) is slice else _values(places).tolist()
            for number, row in zip(numbers, rows, strict=True):
                found[names[number]] = row
        if set(found) != set(names) or len(set(names)) < len(names) or not all(type(name) is str for name in names):
            raise ValueError("its columns are not those that it names")
        if len({len(values) for values in found.values()}) > 1:
            raise ValueError("its columns have different lengths")
        return found


class _Index:
    """Marks the class of an index."""


class _Dict(dict):
    """A dictionary whose keys are scalars: a deep tuple as a key would exhaust the stack of the process."""

    def __setitem__(self, key: Any, value: Any) -> None:
        if type(key) not in SCALARS:
            raise pickle.UnpicklingError(f"a key is a {type(key).__name__}")
        super().__setitem__(key, value)


def _values(array: Any) -> np.ndarray:
    """The values of an array under construction."""
    if not isinstance(array, _Array) or array.view is None:
        raise ValueError("it has no array where one belongs")
    return array.view


def _index(kind: type, content: dict) -> Any:
    """The values of an index; None for a range."""
    return content.get("data")


def _block(values: Any, places: Any, _: int) -> tuple:
    return values, places


_CLASSES = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _Array,
    **{
        (f"numpy.{core}.{module}", name): kind
        for core in ("core", "_core")  # numpy 1 and 2 name the same package differently
        for module, name, kind in (("multiarray", "_reconstruct", _Array), ("numeric", "_frombuffer", _Buffer))
    },
    ("pandas.core.frame", "DataFrame"): _Frame,
    ("pandas.core.internals.managers", "BlockManager"): _Manager,
    ("pandas._libs.internals", "_unpickle_block"): _block,
    ("pandas.core.indexes.base", "_new_Index"): _index,
    ("pandas.core.indexes.base", "Index"): _Index,
    ("pandas.core.indexes.range", "RangeIndex"): _Index,
    ("pandas.core.indexes.numeric", "Int64Index"): _Index,
    ("builtins", "slice"): slice,
}


class _Opcodes:
    """The methods of an unpickler by opcode, at most MAX_OPCODES times."""

    def __init__(self, methods: dict[int, Callable]):
        self._methods, self._left = methods, MAX_OPCODES

    def __getitem__(self, opcode: int) -> Any:
        self._left -= 1
        if opcode not in self._methods or self._left < 0:
            raise pickle.UnpicklingError(f"it has the opcode {bytes([opcode])!r}, or more than {MAX_OPCODES} opcodes")
        return self._methods[opcode]


class _Unpickler(pickle._Unpickler):
    """Executes the opcodes of pickled tables in the protocols 2 to 5."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self.dispatch = _Opcodes(_METHODS)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _CLASSES:
            raise pickle.UnpicklingError(f"it refers to {module}.{name}")
        return _CLASSES[module, name]

    def load_dict(self) -> None:
        self.append(_Dict())

    def load_buffer(self) -> None:
        self.append(self.read(*struct.unpack("<Q", self.read(8))))

    def load_state(self) -> None:
        state = self.stack.pop()
        self.stack[-1].__setstate__(state)


_METHODS = {getattr(pickle, name)[0]: pickle._Unpickler.dispatch[getattr(pickle, name)[0]] for name in _OPCODES} | {
    pickle.EMPTY_DICT[0]: _Unpickler.load_dict,
    pickle.BYTEARRAY8[0]: _Unpickler.load_buffer,
    pickle.BUILD[0]: _Unpickler.load_state,
}
