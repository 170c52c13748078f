"""The settings that all benchmark files have in common, and how the files are read."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pydantic import Field, field_validator

from drivesplat.errors import ConfigError
from drivesplat.io.yaml_file import read_yaml
from drivesplat.settings import Settings, validated
from drivesplat.settings.config import DATASET_OVERRIDES, require_known
from drivesplat.settings.method import Seeds
from drivesplat.settings.names import require_text

SHARED_SETTINGS = (*DATASET_OVERRIDES, "datasets", "methods", "subjects", "lpips", "random_seed")
"""The sections of config.yaml that `config` of a benchmark file may set."""


class BenchmarkFile(Settings):
    base: tuple[str, ...] = ()
    """Config files laid over config.yaml in this order, as with Snakemake's --configfile."""
    config: dict[str, Any] = Field(default_factory=dict)
    """Settings for all trainings, as a tree, laid over these files and over the dataset's own overrides."""
    scene: str
    """The scene to train on; quoted."""
    seeds: Seeds = (0, 1, 2)
    """Random seeds: every training is repeated with each."""

    @field_validator("scene", mode="before")
    @classmethod
    def _is_quoted(cls, value: Any) -> Any:
        require_text(value)
        return value


File = TypeVar("File", bound=BenchmarkFile)


def read_file(path: str | Path, kind: type[File], document: str, changes: Mapping[str, Any] | None = None) -> File:
    """The content of a benchmark file of a `kind` that `document` describes, with `changes` laid over its top level.

    Raises ConfigError, in one line that names the file, if it is missing or invalid.
    """
    content = read_yaml(path, "benchmark file")
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: a benchmark file sets a scene, seeds and more by name; see {document}")
    with error_prefix(str(path)):
        file = validated(kind, {**content, **(changes or {})}, document=document)
        require_known(file.config, SHARED_SETTINGS, "config")
    return file


@contextmanager
def error_prefix(where: str) -> Iterator[None]:
    """Puts `where` before the message of a ConfigError or ValueError, and raises a ConfigError."""
    try:
        yield
    except (ConfigError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from None
