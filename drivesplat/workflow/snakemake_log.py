"""What Snakemake logs and records: reasons of jobs, with changed settings by name, the moment when all jobs are
planned, and records of results that it fails on.

None is a documented interface: tests/workflow/test_snakemake_log.py and test_snakemake_records.py fail where that
changes.
"""

import ast
import base64
import binascii
import json
import logging
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from drivesplat.errors import DriveSplatError
from drivesplat.io.storage import leaves

MAX_CHANGES = 6
"""Maximum number of changed settings that a reason names."""
MAX_VALUE = 60
"""Characters of a value in a reason."""
ABSENT = "(absent)"
_LITERAL = r"""(?:'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")"""
_PARAMS = rf"({_LITERAL}(?:,{_LITERAL})*|<nothing exclusive>)"
_CHANGED_PARAMS = re.compile(
    "Params have changed since last execution: Union of exclusive params before and now across all output: "
    f"before: {_PARAMS} now: {_PARAMS} ?"
)
_DIGEST = re.compile("[0-9a-f]{64}")
METADATA = Path(".snakemake/metadata")
SHOWN = 3
"""Maximum number of results that the message names."""


def when_planned(workflow: Any, check: Callable[[Iterable[Any]], None]) -> Callable[[logging.LogRecord], bool]:
    """A filter of Snakemake's logger that drops no record: before Snakemake shows which jobs of a `workflow` are to
    run, or runs one, `check` gets them, and ends the process where it raises DriveSplatError."""

    def checked(record: logging.LogRecord) -> bool:
        if hasattr(record, "stats"):
            try:
                check(workflow.dag.needrun_jobs())
            except DriveSplatError as error:
                sys.exit(f"drivesplat: {error}")
        return True

    return checked


def name_changes(record: logging.LogRecord) -> bool:
    """A filter of Snakemake's logger, which shortens the reason of a job in place, where its params have changed, and
    drops no record."""
    reason = getattr(record, "reason", None)
    if isinstance(reason, str):
        rule, wildcards = getattr(record, "rule_name", ""), getattr(record, "wildcards", {})
        job = " ".join([rule, *filter(None, [wildcards.get("method")])])
        record.reason = _CHANGED_PARAMS.sub(lambda found: f"{job}: {_changes(rule, *found.groups())}", reason)
    return True


def _changes(rule: str, before: str, now: str) -> str:
    """What has changed in the params of a rule: 'train.ssim_weight 0.2 -> 0.3'."""
    params = [[ast.literal_eval(literal) for literal in re.findall(_LITERAL, text)] for text in (before, now)]
    # the settings among the params, by their paths; empty where there are none
    records = ([json.loads(value) for value in sorted(values) if value.startswith("{")] for values in params)
    old, new = (leaves(found[-1]) if found else {} for found in records)
    keys = sorted(key for key in old.keys() | new.keys() if (key in old, old.get(key)) != (key in new, new.get(key)))
    changes = [f"{key} {_value(old, key)} -> {_value(new, key)}" for key in keys[:MAX_CHANGES]]
    if len(keys) > MAX_CHANGES:
        changes.append(f"and {len(keys) - MAX_CHANGES} more settings")
    if any(_DIGEST.fullmatch(value) for values in params for value in values):
        changes.append(f"code of {rule} changed")
    others = [
        ", ".join(value for value in values if not (_DIGEST.fullmatch(value) or value.startswith("{")))
        for values in params
    ]
    if any(others):
        changes.append(" -> ".join(values or ABSENT for values in others))
    return "; ".join(changes)


def _value(values: dict[str, Any], key: str) -> str:
    text = json.dumps(values[key]) if key in values else ABSENT
    return text if len(text) <= MAX_VALUE else f"{text[:MAX_VALUE]}…"


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
