"""Pickles of plain containers, scalars and numpy arrays, read without the unpickler.

A pickle is a program: its unpickler imports and calls what the file names, and numpy's `__setstate__` trusts the layout
that the file states. Here a small machine executes the few opcodes that plain data needs. It calls nothing that a file
names; arrays are built from the bytes in the file after dtype and shape have been checked. Sizes are bounded by the
file's.
"""

import io
import math
import pickle
import pickletools
import re
import sys
from enum import Enum
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.io.storage import atomic_write, unreadable

MAX_DEPTH = 64
"""Containers within containers."""
MAX_ITEMS = 1_000_000
"""Items of all containers together; what is used twice counts twice."""
MAX_OPCODES = 4 * MAX_ITEMS
MAX_DIMENSIONS = 8

_SCALARS = (type(None), bool, int, float, str, bytes)
_CODE = re.compile(r"[biufSU][1-9][0-9]{0,8}")


class _Global(Enum):
    """What a pickle of plain data refers to by name."""

    DTYPE = "dtype"
    NDARRAY = "ndarray"
    RECONSTRUCT = "_reconstruct"
    FROM_BUFFER = "_frombuffer"


_GLOBALS = {("numpy", "dtype"): _Global.DTYPE, ("numpy", "ndarray"): _Global.NDARRAY} | {
    (f"numpy.{core}.{module}", name.value): name
    for core in ("core", "_core")  # numpy 1 and 2 name the same package differently
    for module, name in (("multiarray", _Global.RECONSTRUCT), ("numeric", _Global.FROM_BUFFER))
}


def write_plain_pickle(path: str | Path, value: Any) -> None:
    """Pickles plain containers and numpy arrays; refuses with a TypeError what `read_plain_pickle` does not read."""
    _Plain().of(value)
    with atomic_write(path) as file:
        pickle.dump(value, file, protocol=4)


def read_plain_pickle(path: str | Path, rule: str) -> Any:
    """Reads what `write_plain_pickle` wrote, by numpy 1 or 2. Raises ResultError naming `path` and `rule`."""
    try:
        return loads(Path(path).read_bytes())
    except OSError as error:
        raise unreadable(path, rule, f"cannot be read ({error.strerror})") from error
    except Exception as error:  # a forged program fails in many ways: every one means "not our file"
        raise unreadable(path, rule, f"not a pickle of plain data and arrays ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def loads(content: bytes) -> Any:
    """The value of a pickle of plain data. Raises an exception of any type where it is none."""
    machine, file = _Machine(len(content)), io.BytesIO(content)
    for opcode, argument, _ in islice(pickletools.genops(file), MAX_OPCODES):
        machine.execute(opcode.name, argument)
    if file.tell() != len(content):
        raise pickle.UnpicklingError("something follows its end")
    (value,) = machine.stack
    return _Plain().of(value)


class _Dtype:
    """A dtype under construction: `code` as in 'f8'."""

    def __init__(self, code: str, align: bool, copy: bool):
        if not _CODE.fullmatch(code) or (align, copy) != (False, True):
            raise pickle.UnpicklingError("an array has another dtype than numbers or text")
        self.code, self.dtype = code, None

    def build(self, state: tuple) -> None:
        version, order, *fields, size, _, _ = state
        dtype = np.dtype(order + self.code)
        if (version, *fields) != (3, None, None, None) or order not in "<>|" or size not in (-1, dtype.itemsize):
            raise pickle.UnpicklingError("an array has another layout than its dtype")
        self.dtype = dtype


class _Array:
    """An array under construction."""

    value: np.ndarray | None = None


class _Machine:
    """Executes pickle opcodes. All arrays together take no more than `size` bytes."""

    def __init__(self, size: int):
        self.stack: list[Any] = []
        self._free = size
        self._below: list[list[Any]] = []
        self._memo: dict[int, Any] = {}

    def execute(self, name: str, argument: Any) -> None:
        """Executes an opcode of the protocols 2 to 5, by its name in `pickletools`."""
        stack = self.stack
        match name:
            case "PROTO" | "FRAME" | "STOP":
                pass
            case "NONE" | "NEWTRUE" | "NEWFALSE":
                stack.append({"NONE": None, "NEWTRUE": True, "NEWFALSE": False}[name])
            case "BININT" | "BININT1" | "BININT2" | "LONG1" | "LONG4" | "BINFLOAT":
                stack.append(argument)
            case "SHORT_BINUNICODE" | "BINUNICODE" | "BINUNICODE8":
                stack.append(argument)
            case "SHORT_BINBYTES" | "BINBYTES" | "BINBYTES8" | "BYTEARRAY8":
                stack.append(bytes(argument))
            case "MARK":
                self._below.append(stack)
                self.stack = []
            case "MEMOIZE":
                self._memo[len(self._memo)] = stack[-1]
            case "BINPUT" | "LONG_BINPUT":
                self._memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(self._memo[argument])
            case "GLOBAL":
                stack.append(_named(*argument.split(" ")))
            case "STACK_GLOBAL":
                stack.append(_named(*self._pop(2)))
            case _:
                self._construct(name)

    def _construct(self, name: str) -> None:
        stack = self.stack
        match name:
            case "EMPTY_LIST" | "EMPTY_DICT" | "EMPTY_TUPLE":
                stack.append({"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple}[name]())
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(self._pop(int(name[-1]))))
            case "TUPLE":
                self.stack, items = self._below.pop(), stack
                self.stack.append(tuple(items))
            case "APPEND" | "SETITEM":
                _extend(stack[-2 if name == "APPEND" else -3], self._pop(1 if name == "APPEND" else 2))
            case "APPENDS" | "SETITEMS":
                self.stack, items = self._below.pop(), stack
                _extend(self.stack[-1], items)
            case "REDUCE":
                function, arguments = self._pop(2)
                stack.append(self._call(function, arguments))
            case "BUILD":
                target, state = stack[-2], self._pop(1)[0]
                self._build(target, state)
            case _:
                raise pickle.UnpicklingError(f"it has the opcode {name}")

    def _pop(self, count: int) -> list[Any]:
        items = self.stack[-count:]
        del self.stack[-count:]
        return items

    def _call(self, function: Any, arguments: tuple) -> Any:
        if function is _Global.DTYPE:
            return _Dtype(*arguments)
        if function is _Global.RECONSTRUCT and arguments == (_Global.NDARRAY, (0,), b"b"):
            return _Array()
        if function is _Global.FROM_BUFFER:
            content, dtype, shape, order = arguments
            return self._array(shape, dtype, order, content)
        raise pickle.UnpicklingError("it calls what no plain data needs")

    def _build(self, target: Any, state: tuple) -> None:
        if type(target) is _Dtype:
            target.build(state)
        elif type(target) is _Array:
            version, shape, dtype, fortran, content = state
            if version != 1:
                raise pickle.UnpicklingError("an array has an unknown version")
            target.value = self._array(shape, dtype, "F" if fortran else "C", content)
        else:
            raise pickle.UnpicklingError("it sets the state of what has none")

    def _array(self, shape: tuple[int, ...], dtype: _Dtype, order: str, content: bytes) -> np.ndarray:
        """The array whose elements are `content`. Raises UnpicklingError where that does not fit."""
        kind = dtype.dtype if type(dtype) is _Dtype else None
        if kind is None or not all(type(n) is int and n >= 0 for n in shape) or len(shape) > MAX_DIMENSIONS:
            raise pickle.UnpicklingError("an array has no dtype or no shape")
        if type(content) is not bytes or math.prod(shape) * kind.itemsize != len(content):
            raise pickle.UnpicklingError("an array has another number of bytes than its shape and dtype")
        self._free -= len(content)
        if self._free < 0:
            raise pickle.UnpicklingError("its arrays are larger than the file")
        array = np.ndarray(shape, kind, bytearray(content), order=order)
        codes, limit = {"b": ("u1", 1), "U": (f"{kind.byteorder}u4", sys.maxunicode)}.get(kind.kind, (None, None))
        if codes and array.size and (np.frombuffer(content, codes) > limit).any():
            raise pickle.UnpicklingError("an array has elements that are no truth values or characters")
        return array


def _named(module: str, name: str) -> _Global:
    if (module, name) not in _GLOBALS:
        raise pickle.UnpicklingError(f"it refers to {module}.{name}")
    return _GLOBALS[module, name]


def _extend(container: Any, items: list[Any]) -> None:
    if type(container) is list:
        container.extend(items)
    elif type(container) is dict:
        for key, value in zip(items[::2], items[1::2], strict=True):
            if type(key) not in _SCALARS:
                raise pickle.UnpicklingError(f"a key is a {type(key).__name__}")
            container[key] = value
    else:
        raise pickle.UnpicklingError("it adds to what is no container")


class _Plain:
    """Copies containers; raises TypeError for anything but plain containers, scalars and arrays, and for too many or
    too deep ones. A subclass of one is not plain."""

    def __init__(self):
        self._left = MAX_ITEMS

    def of(self, value: Any, depth: int = 0) -> Any:
        self._left -= 1
        if self._left < 0 or depth > MAX_DEPTH:
            raise TypeError(f"more than {MAX_ITEMS} items or {MAX_DEPTH} levels are not plain data")
        kind = type(value)
        if kind is dict:
            if any(type(key) not in _SCALARS for key in value):
                raise TypeError("a key is not plain data")
            return {key: self.of(item, depth + 1) for key, item in value.items()}
        if kind in (list, tuple):
            return kind([self.of(item, depth + 1) for item in value])
        if kind is _Array and value.value is not None:
            return value.value
        if kind is np.ndarray and (_CODE.fullmatch(value.dtype.str[1:]) is None or value.ndim > MAX_DIMENSIONS):
            raise TypeError(f"an array of {value.dtype} with {value.ndim} dimensions is not plain data")
        if kind not in (*_SCALARS, np.ndarray):
            raise TypeError(f"{kind.__name__} is not plain data")
        return value
