"""The modules that read a dataset, found by name in the package `drivesplat.readers.<reader>`.

`layout` locates the files (`find_root`, `table_files`), names the cameras (`camera_names`) and is cheap to import;
`reader` reads a scene (`read`). A dataset with LiDAR also has `sweep_file`, which reads a sweep
(`drivesplat.readers.sweeps`); one with large tables has `scene_tables`, which splits them into a file per scene
(`index_tables`, `scene_file`); one whose images and sweeps are no files of their own has `unpack`, which writes them as
such (`unpack`). `DatasetSettings.reader` lists the allowed names of readers.
"""

from types import ModuleType

from drivesplat.readers.by_name import dataset_module, has_module

LAYOUT = "drivesplat.readers.*.layout"
SCENE_TABLES = "drivesplat.readers.*.scene_tables"
READER = "drivesplat.readers.*.reader"
UNPACK = "drivesplat.readers.*.unpack"


def layout(name: str) -> ModuleType:
    """The module that locates a dataset's files. Raises DatasetError for an unknown reader."""
    return dataset_module(LAYOUT, name)


def index(name: str) -> ModuleType | None:
    """The module that splits a dataset's tables into scenes; None if the reader has none."""
    return dataset_module(SCENE_TABLES, name) if has_module(SCENE_TABLES, name) else None


def reads_unposed(name: str) -> bool:
    """Whether a reader reads drives without poses, for stages that estimate them (`layout.POSES_OPTIONAL`)."""
    return getattr(layout(name), "POSES_OPTIONAL", False)


def missing_package(name: str) -> str | None:
    """The package that a reader needs and this Python lacks, with what to do (`layout.missing_package`)."""
    return getattr(layout(name), "missing_package", lambda: None)()


def unpacker(name: str) -> ModuleType | None:
    """The module that writes a dataset's images and sweeps as files; None if they are files already."""
    return dataset_module(UNPACK, name) if has_module(UNPACK, name) else None


def reader(name: str) -> ModuleType:
    """The module that reads a dataset's scenes. Raises DatasetError for an unknown reader."""
    return dataset_module(READER, name)
