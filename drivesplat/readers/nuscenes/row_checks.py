"""Checks of the rows of one scene before nuscenes-devkit indexes them: columns, unique tokens, references, and links.

Poses, sizes and intrinsics are checked where the reader converts them (`drivesplat.readers.checks`), so that damaged
rows of sensors that are not read refuse no drive.
"""

from collections.abc import Callable
from typing import Any

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import checked_flag, checked_text, checked_timestamp, named, shown
from drivesplat.readers.drive_checks import chain, require_unique

Rows = dict[str, list[dict[str, Any]]]


def _token(value: Any, record: str, column: str) -> None:
    checked_text(value, record, column)


def _text(value: Any, record: str, column: str) -> None:
    checked_text(value, record, column, empty=True)


def _description(value: Any, record: str, column: str) -> None:
    if value is not None:
        checked_text(value, record, column, empty=True)


def _timestamp(value: Any, record: str, column: str) -> None:
    checked_timestamp(value, record)


_COLUMNS: dict[str, dict[str, Callable[[Any, str, str], Any]]] = {
    "scene": {"name": _token, "log_token": _token, "first_sample_token": _token},
    "sample": {"scene_token": _token, "timestamp": _timestamp, "next": _text},
    "sample_data": {
        "sample_token": _token, "ego_pose_token": _token, "calibrated_sensor_token": _token, "timestamp": _timestamp,
        "is_key_frame": checked_flag, "next": _text,
    },
    "sample_annotation": {"sample_token": _token, "instance_token": _token},
    "instance": {"category_token": _token},
    "calibrated_sensor": {"sensor_token": _token},
    "sensor": {"channel": _token, "modality": _token},
    "category": {"name": _token},
    "map": {"filename": _token},
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
    """Raises DatasetError naming the table and the token of the first row whose columns are absent or of another type,
    whose token is not unique, or that refers to a row that does not exist; and if the scene's samples are no chain."""
    for table, columns in _COLUMNS.items():
        for row in tables[table]:
            _check_columns(table, row, columns)
        if table != "map":  # its rows are split: one per log
            require_unique((row["token"] for row in tables[table]), table)
    tokens = {table: {row["token"] for row in tables[table]} for table in _COLUMNS}
    for table, references in _REFERENCES.items():
        for column, other in references.items():
            for row in tables[table]:
                if row[column] not in tokens[other]:
                    raise _missing(other, row[column], named(table, row["token"]))
    for log in tables["log"]:
        if all(log["token"] not in row["log_tokens"] for row in tables["map"]):
            raise DatasetError(f"{named('log', log['token'])}: no row of the table map refers to it")
    _check_samples(tables)
    _check_key_frames(tables)


def _check_columns(table: str, row: Any, columns: dict[str, Callable[[Any, str, str], Any]]) -> None:
    token = row.get("token")
    checked_text(token, f"a row of the table {table} ({shown(row)})", "token")
    record = f"{table} {token}"
    for column, check in columns.items():
        if column not in row:
            raise DatasetError(f"{named(table, token)}: it has no {column}")
        check(row[column], record, column)
    optional = _OPTIONAL.get(table)
    if optional is not None:
        _description(row.get(optional), record, optional)


def _missing(table: str, token: str, by: str) -> DatasetError:
    return DatasetError(f"{named(table, token)} is referred to by {by}, but not in the tables")


def _check_samples(tables: Rows) -> None:
    following = {row["token"]: row["next"] for row in tables["sample"]}

    def next_of(token: str) -> str:
        if following[token] and following[token] not in following:
            raise _missing("sample", following[token], named("sample", token))
        return following[token]

    linked = set(chain(tables["scene"][0]["first_sample_token"], next_of, "sample"))
    for row in tables["sample"]:
        if row["token"] not in linked:
            raise DatasetError(
                f"{named('sample', row['token'])}: it is in the scene, but the chain of samples does not lead to it"
            )


def _check_key_frames(tables: Rows) -> None:
    """Raises DatasetError where two recordings of a sensor are key frames of one sample, or one instance has two boxes
    in a sample: either would be used at random."""
    sensors = {row["token"]: row["sensor_token"] for row in tables["calibrated_sensor"]}
    recordings = [
        (row["sample_token"], sensors[row["calibrated_sensor_token"]], row["token"])
        for row in tables["sample_data"]
        if row["is_key_frame"]
    ]
    twice = _first_repeated(recordings)
    if twice:
        raise DatasetError(
            f"{named('sample_data', twice[2])}: its sample {twice[0]} has another recording of its sensor"
        )
    boxes = [(row["sample_token"], row["instance_token"], row["token"]) for row in tables["sample_annotation"]]
    twice = _first_repeated(boxes)
    if twice:
        raise DatasetError(
            f"{named('sample_annotation', twice[2])}: instance {twice[1]} has another box in sample {twice[0]}"
        )


def _first_repeated(entries: list[tuple[str, str, str]]) -> tuple[str, str, str] | None:
    """The first entry whose first two values an earlier one has."""
    seen: set[tuple[str, str]] = set()
    for entry in entries:
        if entry[:2] in seen:
            return entry
        seen.add(entry[:2])
    return None
