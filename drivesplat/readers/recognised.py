"""Which dataset a folder holds, by the files that lie in it."""

from pathlib import Path
from typing import NamedTuple, get_args

from drivesplat.readers.by_name import dataset_module
from drivesplat.settings.dataset import DatasetSettings

RECOGNITION = "drivesplat.readers.*.recognition"
"""The module of a reader with `recognised`, the name of its `FORMAT`, the `SIGN` of it in a folder, and its `PAGE`."""
READERS: tuple[str, ...] = get_args(DatasetSettings.model_fields["reader"].annotation)


class Recognised(NamedTuple):
    """Recordings in a folder: the `root` and the `version` of `datasets`, the names of the `scenes`, and the file by
    which the format was recognised."""

    root: Path
    version: str
    scenes: tuple[str, ...]
    sign: Path


def in_folder(folder: Path) -> dict[str, list[Recognised]]:
    """What a folder holds by the name of its reader; empty for a folder without recordings. Raises DatasetError for
    tables that are damaged."""
    found = {name: list(dataset_module(RECOGNITION, name).recognised(folder)) for name in READERS}
    return {name: recordings for name, recordings in found.items() if recordings}


def format_name(reader: str) -> str:
    """What a reader reads, in words."""
    return dataset_module(RECOGNITION, reader).FORMAT


def known_formats() -> str:
    """The formats with the files by which they are recognised, in words."""
    modules = (dataset_module(RECOGNITION, name) for name in READERS)
    return ", ".join(f"{module.FORMAT} ({module.SIGN}, {module.PAGE})" for module in modules)
