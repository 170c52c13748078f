"""Checks of the rows of one scene before nuscenes-devkit indexes them: columns, unique tokens, references, and links.

Poses, sizes and intrinsics are checked where the reader converts them (`drivesplat.readers.checks`), so that damaged
rows of sensors that are not read refuse no drive.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import MAX_TIMESTAMP, checked_flag, checked_text, checked_timestamp
from drivesplat.readers.drive_checks import chain, require_unique
from drivesplat.readers.record_names import MAX_TEXT, named, shown

MIN_FRACTIONAL = 1e14
"""Least timestamp in microseconds that may have a fraction."""
Rows = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class _Kind:
    """A kind of column: the check of a value, and a test of all values of a column at once, which takes a tenth of the
    time. Values that fail the test are checked one by one."""

    check: Callable[[Any, str, str], Any]
    all_sound: Callable[[list[Any]], bool]


def _sound_texts(values: list[Any]) -> bool:
    texts = set(map(type, values)) <= {str}
    return texts and max(map(len, values), default=0) <= MAX_TEXT and "".join(values).isprintable()


def _sound_times(values: list[Any]) -> bool:
    return set(map(type, values)) <= {int} and 0 <= min(values, default=0) <= max(values, default=0) <= MAX_TIMESTAMP


def _optional_text(value: Any, record: str, column: str) -> None:
    if value is not None and not (isinstance(value, str) and value.encode(errors="ignore").decode() == value):
        raise DatasetError(f"{record}: its {column} is {shown(value)}; it must be text, or null")


_TOKEN = _Kind(checked_text, lambda values: _sound_texts(values) and all(values))
_TEXT = _Kind(partial(checked_text, empty=True), _sound_texts)
_OPTIONAL_TEXT = _Kind(_optional_text, _sound_texts)
_TIMESTAMP = _Kind(lambda value, record, column: checked_timestamp(value, record), _sound_times)
_FLAG = _Kind(checked_flag, lambda values: set(map(type, values)) <= {bool})
_COLUMNS: dict[str, dict[str, _Kind]] = {
    "scene": {"name": _TOKEN, "log_token": _TOKEN, "first_sample_token": _TOKEN},
    "sample": {"scene_token": _TOKEN, "timestamp": _TIMESTAMP, "next": _TEXT},
    "sample_data": {
        "sample_token": _TOKEN, "ego_pose_token": _TOKEN, "calibrated_sensor_token": _TOKEN, "timestamp": _TIMESTAMP,
        "is_key_frame": _FLAG, "next": _TEXT,
    },
    "sample_annotation": {"sample_token": _TOKEN, "instance_token": _TOKEN},
    "instance": {"category_token": _TOKEN},
    "calibrated_sensor": {"sensor_token": _TOKEN},
    "sensor": {"channel": _TOKEN, "modality": _TOKEN},
    "category": {"name": _TOKEN},
    "map": {"filename": _TOKEN},
    "ego_pose": {}, "log": {}, "attribute": {}, "visibility": {},
}  # fmt: skip
"""The required columns of each table, besides `token`."""
_OPTIONAL = {"scene": "description", "sample_annotation": "visibility_token"}
"""Columns of text that may be absent or null."""
_REFERENCES = {
    "sample_data": {"sample_token": "sample", "calibrated_sensor_token": "calibrated_sensor"},
    "sample_annotation": {"sample_token": "sample", "instance_token": "instance"},
    "instance": {"category_token": "category"},
    "calibrated_sensor": {"sensor_token": "sensor"},
    "scene": {"first_sample_token": "sample", "log_token": "log"},
}
"""Columns with the token of another table's row, which nuscenes-devkit follows for every row."""


def check_rows(tables: Rows) -> None:
    """Rounds timestamps. Raises DatasetError naming the table and the token of the first row whose columns are absent
    or of another type, whose token is not unique, or that refers to a row that does not exist; and if the scene's
    samples are no chain."""
    for table, columns in _COLUMNS.items():
        rows = tables[table]
        # Fractions, as Lyft's tables have them, become the nearest microsecond, half a one down. Timestamps are
        # microseconds if they are after 1973: seconds and milliseconds are below.
        for row in rows if "timestamp" in columns else ():
            time = row.get("timestamp")
            if type(time) is float and MIN_FRACTIONAL <= time <= MAX_TIMESTAMP:
                row["timestamp"] = math.ceil(time - 0.5)
        for column, kind in {"token": _TOKEN, **columns}.items():
            _check_column(table, rows, column, kind)
        if table in _OPTIONAL:
            _check_column(table, [{_OPTIONAL[table]: None, **row} for row in rows], _OPTIONAL[table], _OPTIONAL_TEXT)
        if table != "map":  # its rows are split: one per log
            require_unique([row["token"] for row in rows], table)
    tokens = {table: {row["token"] for row in tables[table]} for table in _COLUMNS}
    for table, references in _REFERENCES.items():
        for column, other in references.items():
            row = next((row for row in tables[table] if row[column] not in tokens[other]), None)
            if row is not None:
                raise _missing(other, row[column], named(table, row["token"]))
    for log in tables["log"]:
        if all(log["token"] not in row["log_tokens"] for row in tables["map"]):
            raise DatasetError(f"{named('log', log['token'])}: no row of the table map refers to it")
    following = {row["token"]: row["next"] for row in tables["sample"]}

    def next_of(token: str) -> str:
        if following[token] and following[token] not in following:
            raise _missing("sample", following[token], named("sample", token))
        return following[token]

    linked = set(chain(tables["scene"][0]["first_sample_token"], next_of, "sample"))
    for token in following:
        if token not in linked:
            raise DatasetError(
                f"{named('sample', token)}: it is in the scene, but the chain of samples does not lead to it"
            )
    _check_key_frames(tables)


def _check_column(table: str, rows: list[dict[str, Any]], column: str, kind: _Kind) -> None:
    if all(column in row for row in rows) and kind.all_sound([row[column] for row in rows]):
        return
    for row in rows:
        token = row.get("token")
        record = named(table, token) if isinstance(token, str) and token else f"a row of {table} ({shown(row)})"
        if column not in row:
            raise DatasetError(f"{record}: it has no {column}")
        kind.check(row[column], record, column)


def _missing(table: str, token: str, by: str) -> DatasetError:
    return DatasetError(f"{named(table, token)} is referred to by {by}, but not in the tables")


def _check_key_frames(tables: Rows) -> None:
    """Raises DatasetError where two recordings of a sensor are key frames of one sample, or one instance has two boxes
    in a sample: either would be used at random."""
    sensors = {row["token"]: row["sensor_token"] for row in tables["calibrated_sensor"]}
    recordings = [
        (row["sample_token"], sensors[row["calibrated_sensor_token"]], row["token"])
        for row in tables["sample_data"]
        if row["is_key_frame"]
    ]
    boxes = [(row["sample_token"], row["instance_token"], row["token"]) for row in tables["sample_annotation"]]
    for table, entries, what in (
        ("sample_data", recordings, "its sample {0} has another recording of its sensor"),
        ("sample_annotation", boxes, "instance {1} has another box in sample {0}"),
    ):
        seen: set[tuple[str, str]] = set()
        for sample, other, token in entries:
            if (sample, other) in seen:
                raise DatasetError(f"{named(table, token)}: {what.format(sample, other)}")
            seen.add((sample, other))
