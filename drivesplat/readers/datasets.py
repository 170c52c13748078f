"""Which modules read a dataset.

A layout knows where the files are (`find_root`, `table_files`) and is cheap to import, a reader reads them (`read`).
"""

from importlib import import_module
from types import ModuleType

LAYOUTS = {"nuscenes": "drivesplat.readers.nuscenes.layout"}
READERS = {"nuscenes": "drivesplat.readers.nuscenes.reader"}


def layout(name: str) -> ModuleType:
    """Where the files of a dataset of this kind (a key of LAYOUTS) are."""
    return import_module(LAYOUTS[name])


def reader(name: str) -> ModuleType:
    """How a dataset of this kind (a key of READERS) is read."""
    return import_module(READERS[name])
