"""Tables that pandas has pickled, such as those of PandaSet, read without executing what the file names.

Stand-ins take the place of the few classes of pandas and numpy that a table of numbers and texts needs
(`drivesplat/io/plain_pickle.py`); a file that names anything else is refused. pandas 0.24 to 2.3 are known.
"""

import gzip
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.io.plain_pickle import CLASSES, Array, Buffer, Dtype, PlainUnpickler, executed

MAX_BYTES = 1 << 29
"""Of an unpacked file."""
SCALARS = (str, int, float, bool, type(None))


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
        frame = executed(content, _TableUnpickler)
        if type(frame) is not _Frame:
            raise ValueError(f"it holds a {type(frame).__name__}")
        return frame.columns()
    except Exception as error:  # a forged program fails in many ways: every one means "no table"
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise DatasetError(f"{path} cannot be read as a table of pandas ({reason})") from error


class _Dtype(Dtype):
    """A dtype, also that of objects."""

    codes = re.compile(rf"O8|{Dtype.codes.pattern}")


class _Array(Array):
    """An array; one of objects has scalars alone."""

    def __setstate__(self, state: tuple) -> None:
        version, shape, dtype, fortran, content = state
        if not isinstance(dtype, _Dtype) or dtype.code != "O8":
            super().__setstate__(state)
            return
        if version != 1 or type(content) is not list or any(type(value) not in SCALARS for value in content):
            raise pickle.UnpicklingError("an array of objects has more than texts and numbers")
        values = np.empty(len(content), dtype=object)
        values[:] = content
        self.view = values.reshape(shape, order="F" if fortran else "C")


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


def _values(array: Any) -> np.ndarray:
    """The values of an array under construction."""
    if not isinstance(array, Array) or array.view is None:
        raise ValueError("it has no array where one belongs")
    return array.view


def _index(kind: type, content: dict) -> Any:
    """The values of an index; None for a range."""
    return content.get("data")


def _block(values: Any, places: Any, _: int) -> tuple:
    return values, places


_CLASSES = {
    **{name: {Array: _Array, Dtype: _Dtype, Buffer: Buffer}[kind] for name, kind in CLASSES.items()},
    ("pandas.core.frame", "DataFrame"): _Frame,
    ("pandas.core.internals.managers", "BlockManager"): _Manager,
    ("pandas._libs.internals", "_unpickle_block"): _block,
    ("pandas.core.indexes.base", "_new_Index"): _index,
    ("pandas.core.indexes.base", "Index"): _Index,
    ("pandas.core.indexes.range", "RangeIndex"): _Index,
    ("pandas.core.indexes.numeric", "Int64Index"): _Index,
    ("builtins", "slice"): slice,
}
_METHODS = {pickle.NEWOBJ[0]: pickle._Unpickler.dispatch[pickle.NEWOBJ[0]]}


class _TableUnpickler(PlainUnpickler):
    """Executes the opcodes of pickled tables."""

    classes, methods = _CLASSES, _METHODS
