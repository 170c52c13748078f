"""Datasets into `Scene` records.

A dataset is two modules here: `{name}_layout` knows its files (`find_root`, `table_files`) and is cheap to import,
`{name}` reads them (`read`). Nothing downstream opens a dataset's tables again.
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
