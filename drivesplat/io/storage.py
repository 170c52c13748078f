"""Atomic writes, and readers of JSON: a file is either complete or absent.

Every writer writes a file beside its target, flushes it to disk and renames it. Every reader raises a ResultError for a
truncated, foreign or unsafe file, which names the file and the rule that rebuilds it.
"""

import csv
import glob
import hashlib
import io
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from drivesplat.errors import ResultError
from drivesplat.io.regular_file import regular_file

ABANDONED_SECONDS = 3600.0

Provenance = dict[str, Any]
"""The settings, code and inputs of a result, as a JSON document (`drivesplat.provenance.record`)."""


def no_provenance() -> Provenance:
    """The provenance of what no stage made."""
    return {"stages": {}, "inputs": {}}


def unreadable(path: str | Path, rule: str, why: str, delete: str | Path | None = None) -> ResultError:
    """The error for a file that cannot be used. `delete` is the rule's declared output, where `path` is not one:
    Snakemake rebuilds declared outputs only."""
    return ResultError(f"{path}: {why}; delete {delete or 'it'} and rerun: the rule '{rule}' rebuilds it")


def unwritable(path: str | Path, why: OSError | str) -> ResultError:
    """The error for a file or folder that cannot be written."""
    reason = why.strerror or why if isinstance(why, OSError) else why
    return ResultError(f"{path}: cannot be written ({reason}); free space or fix its permissions")


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A path beside `path` with the same suffix, for another program or library to write to. It is renamed to `path`
    when the context ends without an exception and the content is on disk.

    Raises ResultError, naming `path`, where the disk is full or the folder cannot be written.
    """
    path = Path(path)
    aside = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # partial files of killed writers: those that have not been modified for an hour
        for partial in path.parent.glob(f".{glob.escape(path.stem)}.[0-9]*.partial{glob.escape(path.suffix)}"):
            with suppress(OSError):
                if time.time() - partial.stat().st_mtime > ABANDONED_SECONDS:
                    partial.unlink()
        yield aside
        _fsync(aside)
        aside.replace(path)
        _fsync(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        with suppress(OSError):
            aside.unlink(missing_ok=True)


@contextmanager
def atomic_write(path: str | Path) -> Iterator[BinaryIO]:
    """A binary file that appears at `path` only when its content is complete and on disk.

    Raises ResultError, naming `path`, where the disk is full or the folder cannot be written.
    """
    with atomic_path(path) as aside, open(aside, "wb") as file:
        yield file


def _fsync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def canonical_json(value: Any) -> str:
    """The canonical JSON text of `value`: sorted keys, no white space. Raises ValueError for NaN and infinity."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def leaves(tree: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """The values of nested mappings by their paths, such as 'train.iterations'."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= leaves(value, f"{above}{key}.") if isinstance(value, Mapping) else {f"{above}{key}": value}
    return found


def sha256_text(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def sha256_file(path: str | Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_json(path: str | Path, value: Any, plain: Callable[[Any], Any] | None = None) -> None:
    """Writes JSON; `plain` makes JSON types of what is none."""
    text = json.dumps(value, indent=1, allow_nan=False, default=plain)
    with atomic_write(path) as file:
        file.write(text.encode() + b"\n")


def write_csv(path: str | Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes these columns of rows as a CSV table; None becomes an empty cell."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=columns, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def read_json(path: str | Path, rule: str) -> Any:
    """The content of a JSON result. Raises ResultError naming `path` and `rule` where it is missing or invalid."""
    try:
        with open(regular_file(path), encoding="utf-8") as file:
            return json.load(file)
    except (OSError, RecursionError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise unreadable(path, rule, f"not a readable JSON file ({error})") from error


def read_record(path: str | Path, rule: str, *keys: str) -> dict[str, Any]:
    """The content of a JSON object with at least `keys`. Raises ResultError naming `path` and `rule` otherwise."""
    record = read_json(path, rule)
    absent = [key for key in keys if key not in record] if isinstance(record, dict) else list(keys)
    if absent:
        raise unreadable(path, rule, f"not what the rule writes (it lacks {', '.join(absent)})")
    return record
