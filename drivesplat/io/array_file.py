"""Files of arrays and plain data: uncompressed .npz archives, which numpy opens with `allow_pickle=False`.

Every array is a member named by its place in the content ('actors/0/points'). The member 'content' is the rest as UTF-8
JSON: {"$array": name} stands for an array, {"$tuple": [...]} for a tuple, {"$items": [[key, value], ...]} for a mapping
whose keys are not text.
"""

import dataclasses
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from drivesplat.io.regular_file import regular_file
from drivesplat.io.storage import atomic_write, unreadable
from drivesplat.io.typed_record import field_values, typed_record

CONTENT = "content"
MAX_DIMENSIONS = 8

R = TypeVar("R")


def write_arrays(
    path: str | Path, content: Any, kind: type = np.ndarray, to_array: Callable[[Any], np.ndarray] = lambda array: array
) -> None:
    """Writes plain containers, scalars, arrays and dataclasses of them, atomically; `kind` is the class of arrays.

    Raises TypeError for anything else, ResultError naming `path` where the disk is full.
    """
    arrays: dict[str, np.ndarray] = {}

    def packed(value: Any, name: str) -> Any:
        if isinstance(value, kind):
            if name in arrays or name == CONTENT:
                raise ValueError(f"two arrays are called {name}")
            arrays[name] = to_array(value)
            return {"$array": name}
        if dataclasses.is_dataclass(value):
            value = field_values(value)
        if type(value) in (list, tuple):
            items = [packed(item, f"{name}/{i}") for i, item in enumerate(value)]
            return items if type(value) is list else {"$tuple": items}
        if isinstance(value, dict):
            items = {key: packed(item, f"{name}/{key}" if name else str(key)) for key, item in value.items()}
            simple = all(type(key) is str and not key.startswith("$") for key in items)
            return items if simple else {"$items": [list(item) for item in items.items()]}
        if value is None or type(value) in (bool, int, float, str):
            return value
        raise TypeError(f"{type(value).__name__} is not plain data")

    plain = json.dumps(packed(content, ""), separators=(",", ":"), allow_nan=False).encode()
    if any(array.dtype.kind not in "biuf" for array in arrays.values()):
        raise TypeError("an array of anything but numbers is not plain data")
    members = {CONTENT: np.frombuffer(plain, dtype=np.uint8), **arrays}
    with atomic_write(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in members.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, version=(1, 0), allow_pickle=False)


def read_arrays(
    path: str | Path, rule: str, from_array: Callable[[np.ndarray], Any] = lambda array: array
) -> dict[str, Any]:
    """Reads what `write_arrays` wrote; `from_array` makes the arrays of the content.

    Raises ResultError naming `path` and `rule` where the file is truncated, damaged, foreign or forged: every byte of
    content is covered by a checksum, and no array is larger than the file.
    """
    try:
        with open(regular_file(path), "rb") as file:
            arrays = _members(file)
        content = _unpacked(json.loads(arrays.pop(CONTENT).tobytes()), arrays, from_array)
        if arrays:
            raise ValueError(f"nothing refers to {', '.join(arrays)}")
        if not isinstance(content, dict):
            raise ValueError("it holds no record")
        return content
    except OSError as error:
        raise unreadable(path, rule, f"cannot be read ({error.strerror or error})") from error
    except Exception as error:  # zip, numpy and JSON each fail in their own ways
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise unreadable(path, rule, f"not a file of arrays of this workflow ({reason})") from error


def read_typed_arrays(path: str | Path, rule: str, kind: type[R], what: str) -> R:
    """Reads a dataclass that `write_arrays` wrote. Raises ResultError naming `path`, `rule` and `what` the record holds
    where the file is invalid."""
    content = read_arrays(path, rule)
    try:
        return typed_record(kind, content)
    except (TypeError, ValueError) as error:
        raise unreadable(path, rule, f"not a record of {what} ({error})") from error


def _unpacked(plain: Any, arrays: dict[str, np.ndarray], from_array: Callable[[np.ndarray], Any]) -> Any:
    """The content, whose arrays are taken out of `arrays`."""
    if isinstance(plain, list):
        return [_unpacked(item, arrays, from_array) for item in plain]
    if not isinstance(plain, dict):
        return plain
    match plain:
        case {"$array": name}:
            return from_array(arrays.pop(name))
        case {"$tuple": items}:
            return tuple(_unpacked(items, arrays, from_array))
        case {"$items": items}:
            return {key: _unpacked(item, arrays, from_array) for key, item in items}
    return {key: _unpacked(item, arrays, from_array) for key, item in plain.items()}


def _members(file: BinaryIO) -> dict[str, np.ndarray]:
    """All arrays of an archive, by name."""
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if sum(member.file_size for member in members) > os.fstat(file.fileno()).st_size:
            raise ValueError("its members are larger than the file")
        arrays = {}
        for member in members:
            with archive.open(member) as content:
                array = np.lib.format.read_array(content, allow_pickle=False)
                more = content.read(1)  # at its end, zipfile compares the checksum
            if more or array.dtype.kind not in "biuf" or array.ndim > MAX_DIMENSIONS:
                raise ValueError(f"{member.filename} is no array of numbers")
            arrays[member.filename.removesuffix(".npy")] = array
    return arrays
