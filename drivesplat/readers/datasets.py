"""Which modules read a dataset.

A layout knows where the files are (`find_root`, `table_files`), an index splits the tables into scenes
(`index_tables`); both are cheap to import. A reader reads a scene (`read`).
"""

from importlib import import_module
from types import ModuleType

LAYOUTS = {"nuscenes": "drivesplat.readers.nuscenes.layout"}
INDICES = {"nuscenes": "drivesplat.readers.nuscenes.scene_tables"}
READERS = {"nuscenes": "drivesplat.readers.nuscenes.reader"}


def layout(name: str) -> ModuleType:
    """Where the files of a dataset of this kind (a key of LAYOUTS) are."""
    return import_module(LAYOUTS[name])


def index(name: str) -> ModuleType:
    """How the tables of a dataset of this kind (a key of INDICES) are split into scenes."""
    return import_module(INDICES[name])


def reader(name: str) -> ModuleType:
    """How a dataset of this kind (a key of READERS) is read."""
    return import_module(READERS[name])
