"""The common part of the commands: their arguments, their output files, and their exit status."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError, DriveSplatError
from drivesplat.io.storage import atomic_write, write_json


def argument_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """The parser of `python -m benchmarks.{name}`, whose help is the module's docstring."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def split_arguments(arguments: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
    """The arguments before `--`, and those after it, which are Snakemake's."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return arguments[:end], arguments[end + 1 :]


def require_workflow(folder: Path) -> None:
    """Raises ConfigError if `folder` holds no workflow."""
    if not (folder / "Snakefile").is_file():
        raise ConfigError(f"there is no Snakefile in {folder.resolve()}: run the command in the workflow's folder")


def write_record(record: dict[str, Any], page: str, out: Path, name: str) -> None:
    """Writes {name}.json and its Markdown page {name}.md into the folder `out`."""
    write_json(out / f"{name}.json", record)
    with atomic_write(out / f"{name}.md") as file:
        file.write(page.encode())


def print_page(page: str, out: Path, name: str) -> None:
    print(f"\n{page}\nWritten: {out / name}.md and {out / name}.json", flush=True)


def run_command(main: Callable[[Sequence[str]], int]) -> None:
    """Ends this process with the status that `main` returns, or with one line for an error of this project."""
    try:
        sys.exit(main(sys.argv[1:]))
    except DriveSplatError as error:
        sys.exit(f"drivesplat: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
