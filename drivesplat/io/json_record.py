"""JSON files that hold one dataclass each, with the version of their schema."""

from pathlib import Path
from typing import TypeVar

import numpy as np

from drivesplat.io.storage import read_json, unreadable, write_json
from drivesplat.io.typed_record import field_values, typed_record

R = TypeVar("R")


def write_typed_json(path: str | Path, record: object, schema: int) -> None:
    """Writes a dataclass; arrays and nested dataclasses become lists and objects."""
    write_json(
        path,
        {"schema": schema, **field_values(record)},
        lambda value: value.tolist() if isinstance(value, np.ndarray) else field_values(value),
    )


def read_typed_json(path: str | Path, rule: str, kind: type[R], schema: int, what: str) -> R:
    """Reads a dataclass that `write_typed_json` wrote. Raises ResultError naming `path`, `rule` and `what` the file
    should be, as in 'a scene record', where it is invalid or has another schema."""
    content = read_json(path, rule)
    try:
        if content.pop("schema") != schema:
            raise ValueError("it has another schema")
        return typed_record(kind, content, json=True)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(path, rule, f"not {what} ({error})") from error
