"""Pickles of plain containers, scalars and numpy arrays, read without executing what they name.

A pickle is a program: its unpickler imports and calls what the file names, and numpy's `__setstate__` trusts the layout
that the file states. Here Python's unpickler executes only the opcodes that plain data needs, and finds classes of this
module in place of numpy's; arrays are built from the bytes in the file after dtype and shape have been checked. Sizes
are bounded by the file's.

The unpickler is the one written in Python, `pickle._Unpickler`. The one in C has no table of opcodes to restrict, and
allocates memory for places and sizes that a file only states.
"""

import io
import math
import pickle
import re
import struct
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.io.regular_file import regular_file
from drivesplat.io.storage import atomic_write, unreadable

MAX_DEPTH = 64
"""Containers within containers."""
MAX_ITEMS = 1_000_000
"""Items of all containers together; what is used twice counts twice."""
MAX_OPCODES = 4 * MAX_ITEMS
MAX_DIMENSIONS = 8

_SCALARS = (type(None), bool, int, float, str, bytes)
_CODE = re.compile(r"[biufSU][1-9][0-9]{0,8}")
_OPCODES = (
    "PROTO", "FRAME", "STOP", "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "LONG4",
    "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "MARK",
    "MEMOIZE", "BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET", "GLOBAL", "STACK_GLOBAL", "EMPTY_LIST", "EMPTY_TUPLE",
    "TUPLE1", "TUPLE2", "TUPLE3", "TUPLE", "APPEND", "APPENDS", "SETITEM", "SETITEMS", "REDUCE",
)  # fmt: skip
"""The opcodes that are executed as usual, by their names in `pickle`."""


def write_plain_pickle(path: str | Path, value: Any) -> None:
    """Pickles plain containers and numpy arrays; refuses with a TypeError what `read_plain_pickle` does not read."""
    _Plain().of(value)
    with atomic_write(path) as file:
        pickle.dump(value, file, protocol=4)


def read_plain_pickle(path: str | Path, rule: str) -> Any:
    """Reads what `write_plain_pickle` wrote, by numpy 1 or 2. Raises ResultError naming `path` and `rule`."""
    try:
        return loads(regular_file(path).read_bytes())
    except OSError as error:
        raise unreadable(path, rule, f"cannot be read ({error.strerror or error})") from error
    except Exception as error:  # a forged program fails in many ways: every one means "not our file"
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise unreadable(path, rule, f"not a pickle of plain data and arrays ({reason})") from error


def loads(content: bytes) -> Any:
    """The value of a pickle of plain data. Raises an exception of any type where it is none."""
    return _Plain(len(content)).of(executed(content, PlainUnpickler))


def executed(content: bytes, unpickler: type["PlainUnpickler"]) -> Any:
    """What an unpickler makes of the whole content, before `loads` copies it. Raises an exception of any type."""
    program = unpickler(io.BytesIO(content))
    value = program.load()
    if program.stack or program.read(1):
        raise pickle.UnpicklingError("something follows its end")
    return value


class Dtype:
    """A dtype under construction: `code` as in 'f8'."""

    codes = _CODE

    def __init__(self, code: str, align: int, copy: int):
        if not self.codes.fullmatch(code) or (align, copy) != (False, True):
            raise pickle.UnpicklingError("an array has another dtype than numbers or text")
        self.code, self.dtype = code, None

    def __setstate__(self, state: tuple) -> None:
        version, order, *fields, size, _, _ = state
        dtype = np.dtype(order + self.code)
        if (version, *fields) != (3, None, None, None) or order not in "<>|" or size not in (-1, dtype.itemsize):
            raise pickle.UnpicklingError("an array has another layout than its dtype")
        self.dtype = dtype


class Array:
    """An array under construction, in place of the result of numpy's `_reconstruct`: `view` of the file's content, and
    `copy` for the caller."""

    view: np.ndarray | None = None
    copy: np.ndarray | None = None

    def __init__(self, kind: type, shape: tuple[int, ...], code: bytes):
        if (kind, shape, code) != (type(self), (0,), b"b"):
            raise pickle.UnpicklingError("it calls what no plain data needs")

    def __setstate__(self, state: tuple) -> None:
        version, shape, dtype, fortran, content = state
        if version != 1:
            raise pickle.UnpicklingError("an array has an unknown version")
        self._look_at(content, dtype, shape, "F" if fortran else "C")

    def _look_at(self, content: bytes, dtype: Dtype, shape: tuple[int, ...], order: str) -> None:
        """Makes `content` the elements. Raises UnpicklingError where it does not fit."""
        kind = dtype.dtype if isinstance(dtype, Dtype) else None
        if kind is None or not all(type(n) is int and n >= 0 for n in shape) or len(shape) > MAX_DIMENSIONS:
            raise pickle.UnpicklingError("an array has no dtype or no shape")
        if type(content) is not bytes or math.prod(shape) * kind.itemsize != len(content):
            raise pickle.UnpicklingError("an array has another number of bytes than its shape and dtype")
        self.view = np.ndarray(shape, kind, content, order=order)
        codes, limit = {"b": ("u1", 1), "U": (f"{kind.byteorder}u4", sys.maxunicode)}.get(kind.kind, (None, None))
        if codes and self.view.size and (np.frombuffer(content, codes) > limit).any():
            raise pickle.UnpicklingError("an array has elements that are no truth values or characters")


class Buffer(Array):
    """An array in place of the result of numpy's `_frombuffer`."""

    def __init__(self, content: bytes, dtype: Dtype, shape: tuple[int, ...], order: str):
        self._look_at(content, dtype, shape, order)


class _Dict(dict):
    """A dictionary whose keys are scalars: a deep tuple as a key would exhaust the stack of the process."""

    def __setitem__(self, key: Any, value: Any) -> None:
        if type(key) not in _SCALARS:
            raise pickle.UnpicklingError(f"a key is a {type(key).__name__}")
        super().__setitem__(key, value)


CLASSES = {("numpy", "dtype"): Dtype, ("numpy", "ndarray"): Array} | {
    (f"numpy.{core}.{module}", name): kind
    for core in ("core", "_core")  # numpy 1 and 2 name the same package differently
    for module, name, kind in (("multiarray", "_reconstruct", Array), ("numeric", "_frombuffer", Buffer))
}


class _Opcodes:
    """The `methods` of an unpickler by opcode, at most MAX_OPCODES times."""

    def __init__(self, methods: dict[int, Callable]):
        self._methods, self._left = methods, MAX_OPCODES

    def __getitem__(self, opcode: int) -> Any:
        self._left -= 1
        if opcode not in self._methods or self._left < 0:
            raise pickle.UnpicklingError(f"it has the opcode {bytes([opcode])!r}, or more than {MAX_OPCODES} opcodes")
        return self._methods[opcode]


class PlainUnpickler(pickle._Unpickler):
    """Executes the opcodes of plain data in the protocols 2 to 5. A subclass may add `classes` in place of those that a
    file names, and `methods` for further opcodes."""

    classes: Mapping[tuple[str, str], Callable] = CLASSES
    methods: Mapping[int, Callable] = {}

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self.dispatch = _Opcodes({**_METHODS, **self.methods})

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.classes:
            raise pickle.UnpicklingError(f"it refers to {module}.{name}")
        return self.classes[module, name]

    def load_dict(self) -> None:
        self.append(_Dict())

    def load_buffer(self) -> None:
        self.append(self.read(*struct.unpack("<Q", self.read(8))))

    def load_state(self) -> None:
        state = self.stack.pop()
        self.stack[-1].__setstate__(state)


_METHODS = {getattr(pickle, name)[0]: pickle._Unpickler.dispatch[getattr(pickle, name)[0]] for name in _OPCODES} | {
    pickle.EMPTY_DICT[0]: PlainUnpickler.load_dict,
    pickle.BYTEARRAY8[0]: PlainUnpickler.load_buffer,
    pickle.BUILD[0]: PlainUnpickler.load_state,
}


class _Plain:
    """Copies containers; raises TypeError for anything but plain containers, scalars and arrays, and for too many or
    too deep ones. A subclass of one is not plain. Arrays in a file take no more than `size` bytes together."""

    def __init__(self, size: int = 0):
        self._left, self._free = MAX_ITEMS, size

    def of(self, value: Any, depth: int = 0) -> Any:
        self._left -= 1
        if self._left < 0 or depth > MAX_DEPTH:
            raise TypeError(f"more than {MAX_ITEMS} items or {MAX_DEPTH} levels are not plain data")
        kind = type(value)
        if kind in (dict, _Dict):
            if any(type(key) not in _SCALARS for key in value):
                raise TypeError("a key is not plain data")
            return {key: self.of(item, depth + 1) for key, item in value.items()}
        if kind in (list, tuple):
            return kind([self.of(item, depth + 1) for item in value])
        if kind in (Array, Buffer) and value.view is not None:
            return self._copied(value)
        if kind is np.ndarray and (_CODE.fullmatch(value.dtype.str[1:]) is None or value.ndim > MAX_DIMENSIONS):
            raise TypeError(f"an array of {value.dtype} with {value.ndim} dimensions is not plain data")
        if kind not in (*_SCALARS, np.ndarray):
            raise TypeError(f"{kind.__name__} is not plain data")
        return value

    def _copied(self, array: Array) -> np.ndarray:
        """A writable array, one for every reference to it."""
        if array.copy is None:
            self._free -= array.view.nbytes
            if self._free < 0:
                raise TypeError("its arrays are larger than the file")
            array.copy = array.view.copy(order="K")
        return array.copy
