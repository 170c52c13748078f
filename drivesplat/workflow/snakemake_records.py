"""Snakemake's records of results, `.snakemake/metadata`: those that it fails on are removed."""

import base64
import binascii
import json
from pathlib import Path

METADATA = Path(".snakemake/metadata")
SHOWN = 3
"""Maximum number of results that the message names."""


def drop_foreign_records(folder: Path = METADATA) -> str | None:
    """Removes the records in `folder` that hold no text or no table, on which Snakemake ends with a traceback.
    Truncated text, such as a record that another run is writing, is left to Snakemake, which ignores it.

    Returns a sentence about the results whose records were removed; None where all are sound.
    """
    foreign = [file for file in sorted(folder.rglob("*")) if file.is_file() and not _is_record(file)]
    if not foreign:
        return None
    for file in foreign:
        file.unlink()
    results = sorted(_result(file.relative_to(folder)) for file in foreign)
    named = ", ".join(results[:SHOWN]) + (f" and {len(results) - SHOWN} more" if len(results) > SHOWN else "")
    return (
        f"{folder}: Snakemake's records of {named} were damaged and have been removed; these results count as up to "
        "date unless an input is newer: delete a result to rebuild it"
    )


def _is_record(file: Path) -> bool:
    try:
        return isinstance(json.loads(file.read_text(encoding="utf-8")), dict)
    except UnicodeDecodeError:
        return False
    except (OSError, ValueError):
        return True


def _result(record: Path) -> str:
    """The path of the result that a record is about, which is its name in base 64, split into folders where long."""
    encoded = "".join(part.removeprefix("@") for part in record.parts)
    try:
        return base64.b64decode(encoded, validate=True).decode()
    except (binascii.Error, UnicodeDecodeError):
        return str(record)
