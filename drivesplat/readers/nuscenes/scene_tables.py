"""Splits nuScenes' tables into one small file of rows per scene.

The tables of v1.0-trainval are 2.5 GB of JSON for 850 scenes and take 8 GB of memory if read whole. This module reads
them once, row by row, and rewrites a scene's file only if its rows have changed. Each line of a file is a row, such as
{"sample": {...}}, in the order of the tables.
"""

import json
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from drivesplat.errors import DatasetError
from drivesplat.io.storage import atomic_path, unwritable, write_json
from drivesplat.readers.nuscenes.layout import TABLES, all_tables
from drivesplat.readers.record_names import named, shown

SCHEMA = 2
PREFIX = "scene-"
"""What may be left out of a scene's name."""
INDEX = ".index.json"
"""File that records the tables from which the files beside it were made."""
LARGE = 200_000_000
"""Size of the tables in bytes above which reading them is announced."""
_CHUNK = 2**22
_BUFFER = 2**26
"""Number of characters per read, and buffered before a write."""
_MAX_ROW = 2**24
"""Maximum number of characters of a row. The rest of a table that is damaged in its middle is not read."""
_BETWEEN_ROWS = re.compile(r"[\s,]*")
_REFERENCES = (
    ("sample", "scene_token", "scene", {"sample": "token"}),
    (
        "sample_data", "sample_token", "sample",
        {"ego_pose": "ego_pose_token", "calibrated_sensor": "calibrated_sensor_token"},
    ),
    ("sample_annotation", "sample_token", "sample", {"instance": "instance_token"}),
    ("ego_pose", "token", "ego_pose", {}),
    ("calibrated_sensor", "token", "calibrated_sensor", {}),
    ("instance", "token", "instance", {}),
    ("log", "token", "log", {}),
)  # fmt: skip
"""A table; the column that determines the scene of a row; the table to whose tokens this column refers; and further
tables that its rows reference, with the column of the token. Referenced rows belong to the same scene."""
_SHARED = ("attribute", "category", "sensor", "visibility")
"""Small tables that are copied for all scenes."""


def index_tables(root: Path, version: str, scenes: Sequence[str], folder: Path) -> list[Path]:
    """Updates the files of `scenes` in `folder` from the tables in `root`/`version`; returns those that it wrote.

    Returns at once if no table has changed its size or modification time. The file of a scene that is not in the tables
    names the scenes that are. Raises DatasetError if a table is damaged, ResultError if `folder` cannot be written.
    """
    files = [(file.name, file.stat()) for file in all_tables(root, version)]
    made_from = {
        "schema": SCHEMA,
        "scenes": list(scenes),
        "root": str(root.absolute()),
        "tables": {name: [stat.st_size, stat.st_mtime_ns] for name, stat in files},
    }
    with suppress(OSError, ValueError):
        known = json.loads((folder / INDEX).read_text(encoding="utf-8"))
        if known == made_from and all(scene_file(folder, scene).is_file() for scene in scenes):
            return []
    size = sum(stat.st_size for _, stat in files)
    if size > LARGE:
        print(f"drivesplat: reading the tables of nuScenes {version} once ({size / 1e9:.1f} GB)", file=sys.stderr)
    written = write_scene_tables(root, version, scenes, folder)
    write_json(folder / INDEX, made_from)
    return written


def scene_file(folder: Path, scene: str) -> Path:
    """The path of a scene's file of rows."""
    return folder / f"{scene}.jsonl"


def write_scene_tables(root: Path, version: str, scenes: Sequence[str], folder: Path) -> list[Path]:
    """Writes the files of `scenes` in `folder` whose content has changed, and returns them.

    Raises DatasetError if a table is damaged, ResultError if `folder` cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        work = TemporaryDirectory(prefix=".made-", dir=folder)
    except OSError as error:
        raise unwritable(folder, error) from error
    with work as made:
        try:
            _append(_rows_of_scenes(root / version, scenes), Path(made))
        except (ValueError, OSError) as error:
            raise damaged(root, version, error) from error
        changed = []
        for scene in scenes:
            new, file = scene_file(Path(made), scene), scene_file(folder, scene)
            if not file.is_file() or file.read_bytes() != new.read_bytes():
                changed.append(file)
                with atomic_path(file) as temporary:
                    new.replace(temporary)
        return changed


def damaged(root: Path, version: str, error: Exception) -> DatasetError:
    """The error for tables that cannot be read."""
    what = f"{error}" if type(error) is ValueError else f"{type(error).__name__}: {error}"
    return DatasetError(f"nuScenes {version} in {root} cannot be read ({what}); unpack it again")


def read_scene_tables(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The rows of every table in a scene's file. Raises DatasetError if it is damaged."""
    tables: dict[str, list[dict[str, Any]]] = {table: [] for table in TABLES}
    try:
        with open(path, encoding="utf-8") as file:
            for line in file:
                ((table, row),) = json.loads(line).items()
                tables[table].append(row)
    except (AttributeError, KeyError, OSError, RecursionError, ValueError) as error:
        raise DatasetError(f"{path} is damaged ({error}); delete it and rerun to recreate it") from error
    return tables


Found = tuple[Iterable[str], str, str]
"""The scenes of a row, its table, and the row as text."""


def _append(found: Iterable[Found], folder: Path) -> None:
    """Appends rows to the files of their scenes, many at a time."""
    lines: dict[Path, list[str]] = defaultdict(list)
    size = 0
    for scenes, table, row in found:
        for scene in scenes:
            lines[scene_file(folder, scene)].append(f'{{"{table}": {row}}}\n')
            size += len(row)
        if size > _BUFFER:
            _flush(lines)
            size = 0
    _flush(lines)


def _flush(lines: dict[Path, list[str]]) -> None:
    for path, added in lines.items():
        try:
            with open(path, "a", encoding="utf-8") as file:
                file.writelines(added)
        except OSError as error:
            raise unwritable(path, error) from error
    lines.clear()


def _rows_of_scenes(tables: Path, scenes: Sequence[str]) -> Iterator[Found]:
    owners: dict[str, dict[str, tuple[str, ...]]] = defaultdict(dict)
    yield from _scene_rows(tables, scenes, owners)
    samples: set[str] = set()
    no_scenes: tuple[str, ...] = ()
    for table, column, owner, references in _REFERENCES:
        owned_by, referred = owners[owner], [(owners[other], token) for other, token in references.items()]
        for text, row in rows(tables / f"{table}.json"):
            token = _token(row, column, table)
            row_scenes = owned_by.get(token, no_scenes)
            if table == "sample":
                samples.add(_token(row, "token", table))
            elif owner == "sample" and token not in samples:
                by = named(table, row.get("token"))
                raise ValueError(f"{named('sample', token)} is referred to by {by}, but not in the tables")
            if row_scenes:
                yield row_scenes, table, text
            for others, token in referred if row_scenes else ():
                other = _token(row, token, table)
                known = others.setdefault(other, row_scenes)
                if known != row_scenes:
                    others[other] = tuple(dict.fromkeys((*known, *row_scenes)))
    for table in _SHARED:
        for text, _ in rows(tables / f"{table}.json"):
            yield scenes, table, text
    for _, row in rows(tables / "map.json"):
        logs = row.get("log_tokens")
        if not isinstance(logs, list) or not all(isinstance(log, str) for log in logs):
            raise ValueError(f"{named('map', row.get('token'))}: its log_tokens must be a list of tokens")
        for log in dict.fromkeys(logs):
            yield owners["log"].get(log, no_scenes), "map", json.dumps({**row, "log_tokens": [log]})


def _token(row: dict[str, Any], column: str, table: str) -> str:
    """The token in a column. Raises ValueError naming the row if it has none."""
    token = row.get(column)
    if not isinstance(token, str):
        what = f"its {column} is {shown(token)}; it must be text" if column in row else f"it has no {column}"
        raise ValueError(f"{named(table, row.get('token'))}: {what}")
    return token


def _scene_rows(tables: Path, scenes: Sequence[str], owners: dict[str, dict[str, tuple[str, ...]]]) -> Iterator[Found]:
    """The rows of the table of scenes; adds to `owners`, per table, the scenes to which each token belongs. A scene is
    called as in the table, or without PREFIX; of one that is not there, the names of those that are."""
    known: dict[str, tuple[str, dict[str, Any]]] = {}
    for text, row in rows(tables / "scene.json"):
        name = _token(row, "name", "scene")
        if name in known:
            raise ValueError(f"{named('scene', row.get('token'))}: its name {name} is that of another scene")
        known[name] = text, row
    for scene in scenes:
        found = known.get(scene) or known.get(f"{PREFIX}{scene}")
        if found is None:
            yield from (([scene], "scene", json.dumps({"name": name})) for name in known)
            continue
        text, row = found
        yield [scene], "scene", text
        for table, token in (("scene", _token(row, "token", "scene")), ("log", _token(row, "log_token", "scene"))):
            owners[table][token] = (*owners[table].get(token, ()), scene)


def rows(table: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Iterates over the rows of a table, each as one line of text and as parsed content, in bounded memory.

    Raises ValueError if the file is not a list of JSON objects.
    """
    decoder = json.JSONDecoder()
    with open(table, encoding="utf-8") as file:
        text = file.read(_CHUNK).lstrip()
        if not text.startswith("["):
            raise ValueError(f"{table.name} is not a list of rows")
        at = 1
        while True:
            at = _BETWEEN_ROWS.match(text, at).end()
            if text.startswith("]", at):
                return
            try:
                row, end = decoder.raw_decode(text, at)
            except RecursionError as error:
                raise ValueError(f"{table.name} is nested too deeply") from error
            except json.JSONDecodeError as error:
                more = file.read(_CHUNK) if len(text) - at <= _MAX_ROW else ""
                if not more:
                    raise ValueError(f"{table.name} ends within a row or is not JSON: {error.msg}") from error
                text, at = text[at:] + more, 0
                continue
            except ValueError as error:  # such as a number of 5,000 digits
                raise ValueError(f"{table.name} cannot be parsed: {error}") from error
            if not isinstance(row, dict):
                raise ValueError(f"{table.name} is not a list of rows: it holds {shown(row)}")
            yield text[at:end].replace("\n", ""), row
            at = end
