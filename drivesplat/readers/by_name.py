"""Modules of datasets by the name of their reader."""

from importlib import import_module
from pathlib import Path
from types import ModuleType

from drivesplat.errors import DatasetError


def dataset_module(pattern: str, name: str) -> ModuleType:
    """The module that a pattern gives with a reader's name for its `*`. The digest of a stage's code holds all modules
    that fit the pattern. Raises DatasetError where there is none."""
    module = pattern.replace("*", name)
    if not has_module(pattern, name):
        raise DatasetError(f"no module {module} reads datasets of reader: {name}; add it (docs/developing.md)")
    return import_module(module)


def has_module(pattern: str, name: str) -> bool:
    """Whether there is the module that a pattern gives with a reader's name for its `*`."""
    return Path(__file__).parent.joinpath(name, pattern.rpartition(".")[2] + ".py").is_file()
