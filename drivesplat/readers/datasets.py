"""Which modules read a dataset: those of the package `drivesplat.readers.<reader>`, by their names.

`layout` knows where the files are (`find_root`, `table_files`) and is cheap to import; `reader` reads a scene (`read`);
`sweep_file` reads a LiDAR sweep (`drivesplat.readers.sweeps`). A dataset of large tables also has `scene_tables`, which
splits them into a file per scene (`index_tables`, `scene_file`). The name of a reader is one of those that
`DatasetSettings.reader` allows.
"""

from types import ModuleType

from drivesplat.readers.by_name import dataset_module, has_module

LAYOUT = "drivesplat.readers.*.layout"
SCENE_TABLES = "drivesplat.readers.*.scene_tables"
READER = "drivesplat.readers.*.reader"


def layout(name: str) -> ModuleType:
    """Where the files of a dataset of this kind are. Raises DatasetError where nothing reads it."""
    return dataset_module(LAYOUT, name)


def index(name: str) -> ModuleType | None:
    """How the tables of a dataset of this kind are split into scenes; None where they are read whole."""
    return dataset_module(SCENE_TABLES, name) if has_module(SCENE_TABLES, name) else None


def reader(name: str) -> ModuleType:
    """How a dataset of this kind is read. Raises DatasetError where nothing reads it."""
    return dataset_module(READER, name)
