"""The edits of a scene, as a YAML file: named edits, each a list of steps. docs/editing.md describes it.

This module imports quickly, since the Snakefile imports it. Checks that need the scene are in `edited_cast`.
"""

import re
from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.io.yaml_file import read_yaml
from drivesplat.settings import quoted, validated
from drivesplat.settings.edit import Edit, Step
from drivesplat.settings.names import MAX_LENGTH, NAME

RESERVED = ("ego",)
"""Names that a duplicate cannot have: `ego` is the ego vehicle."""


def read_edits(path: str | Path) -> dict[str, Edit]:
    """The edits of a file by name, in the file's order.

    Raises ConfigError, one line with the file, the edit and the step, where the file is missing or invalid.
    """
    content = read_yaml(path, "edits file")
    if not isinstance(content, dict) or set(content) != {"edits"}:
        raise ConfigError(f"{path}: an edits file holds the one key 'edits', under it a list of steps per name")
    edits = {} if content["edits"] is None else content["edits"]
    if not isinstance(edits, dict):
        raise ConfigError(f"{path}: 'edits' is {quoted(edits)}; it holds a list of steps per name")
    found = {}
    for name, steps in edits.items():
        require_edit_name(name, f"{path}: edit")
        found[name] = edit_of(steps, f"{path}: edit {name!r}")
    return found


def edit_of(steps: Any, where: str) -> Edit:
    """The edit with the steps of an entry of an edits file. Raises ConfigError, which starts with `where` and names the
    step, where they are invalid.

    >>> edit_of([{"remove": {"track": "6e5c"}}], "my edit").steps[0].kind
    'remove'
    """
    if not isinstance(steps, list) or not steps:
        raise ConfigError(f"{where} is {quoted(steps)}; it is a list of steps, at least one: - remove: {{track: 6e5c}}")
    return Edit(steps=tuple(_step(step, f"{where}, step {number}") for number, step in enumerate(steps, start=1)))


def _step(step: Any, where: str) -> Step:
    kinds = ", ".join(Step.model_fields)
    if not isinstance(step, dict) or len(step) != 1:
        raise ConfigError(f"{where} is {quoted(step)}; a step has one key, one of {kinds}")
    (kind, fields), *_ = step.items()
    if kind not in Step.model_fields:
        raise ConfigError(f"{where}: there is no step {kind!r}; there are: {kinds}")
    where = f"{where} ({kind})"
    if not isinstance(fields, dict):
        example = {"ego": "lateral: 2.0", "insert": "asset: ..."}.get(kind, "track: 6e5c, ...")
        raise ConfigError(f"{where} is {quoted(fields)}; it is a mapping: {kind}: {{{example}}}")
    for key in fields:
        if not isinstance(key, str):
            raise ConfigError(f"{where}: {key!r} stands where a key should; a decimal has a point: 3.5, not 3,5")
    record = Step.model_fields[kind].annotation.__args__[0]
    keys = [field.alias or name for name, field in record.model_fields.items()]
    checked = Step(**{kind: validated(record, fields, f"{where}: ", keys=keys)})
    copy = checked.duplicate or checked.place or checked.insert
    if copy is not None:
        require_edit_name(copy.name, f"{where}: 'as'")
        if copy.name in RESERVED:
            raise ConfigError(f"{where}: 'as' {copy.name!r} is a name kept for the camera's car; choose another")
    return checked


def require_edit_name(name: Any, what: str) -> None:
    """Raises ConfigError, which begins with `what`, for a name that neither an edit nor a copy may have."""
    if not isinstance(name, str):
        raise ConfigError(f"{what} {name!r} is not text: put the name in quotes")
    if not re.fullmatch(NAME, name):
        raise ConfigError(f"{what} {name!r} cannot name a file: use letters, digits, '_', '-' and '.'")
    if len(name) > MAX_LENGTH:
        raise ConfigError(f"{what} {quoted(name)} has {len(name)} characters; use at most {MAX_LENGTH}")
