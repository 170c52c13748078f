"""Checks of the config files on Snakemake's command line, before Snakemake reads them: it reports a broken file without
its line, keeps the last of two equal keys, and takes targets that follow `--configfile` without `--` for config files.

The profiles call this. It imports quickly.
"""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from drivesplat.errors import ConfigError
from drivesplat.io.this_copy import default_config
from drivesplat.io.yaml_file import read_yaml
from drivesplat.settings import quoted

SUFFIXES = (".yaml", ".yml", ".json")


def stop_at_bad_config_files(files: Iterable[str | Path] | None, workdir: str | Path | None, snakefile: Path) -> None:
    """Ends the process with one line where a config file cannot be used: those that follow `--configfile`, and the one
    that the Snakefile reads."""
    try:
        check_config_files([str(file) for file in files or ()])
        read_config(default_config(Path(workdir or "."), snakefile.parent))
    except ConfigError as error:
        sys.exit(f"drivesplat: {error}")


def check_config_files(files: Sequence[str]) -> None:
    """Raises ConfigError, with file and line, for the first of the `files` after `--configfile` that is none."""
    for number, file in enumerate(files):
        if number and not (file.endswith(SUFFIXES) and Path(file).is_file()) and not Path(file).is_fifo():
            before = " ".join(files[:number])
            raise ConfigError(
                f"{file!r} is taken for a config file, since it follows --configfile: put -- before the targets, as in "
                f"--configfile {before} -- {' '.join(files[number:])}"
            )
        read_config(file)


def read_config(path: str | Path) -> None:
    """Raises ConfigError, with file and line, where a config file is missing, empty, broken or has a key twice."""
    content = read_yaml(path, "config file")
    if content is None:
        raise ConfigError(f"{path}: the config file is empty; remove it from --configfile, or put settings into it")
    if not isinstance(content, dict):
        raise ConfigError(f"{path}, line 1: {quoted(content)} is no setting; a config file holds lines 'key: value'")
