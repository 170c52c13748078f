"""Settings: a record per section of config.yaml and per rule, and the generated config.yaml and schema. This module has
their base class, and one-line messages for their errors.

Fields are documented by attribute docstrings, so that a reworded comment does not change the code digest (see
`drivesplat.provenance.code`). A docstring that begins with `:printed:` puts its field into config.yaml, which users
read first; docs/settings.md and config.schema.json have all fields. Only `make config` reads these docstrings
(`drivesplat.settings.config_document`), and records are built when they are first used: both take time that every job
would pay.
"""

from collections.abc import Collection, Mapping, Sequence
from datetime import date
from functools import cache
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from drivesplat.errors import ConfigError

S = TypeVar("S", bound="Settings")
OVERRIDING = ("datasets", "methods", "ablation")
"""Sections with entries that have `overrides`."""
MAX_QUOTED = 80
"""Maximum number of characters of a value in a message."""


class Settings(BaseModel):
    """Immutable settings: unknown keys are refused, field docstrings are the documentation."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True, protected_namespaces=()
    )

    @field_validator("*", mode="before")
    @classmethod
    def _no_text_for_numbers(cls, value: Any, info: Any) -> Any:
        wanted = _numeric_kinds(cls, info.field_name)
        if wanted == {bool} and not isinstance(value, bool):
            raise ValueError("input should be true or false")
        if wanted and wanted != {bool} and isinstance(value, (str, bool)):
            raise ValueError("input should be a number (YAML reads 1e-3 as text: write 1.0e-3)")
        return value


@cache
def _numeric_kinds(model: type[Settings], field: str) -> frozenset[type]:
    """Which of int, float and bool a field may hold. Every value of every settings record asks for it."""
    kinds = model.model_fields[field].annotation
    return frozenset({kinds, *get_args(kinds)} & {int, float, bool})


def validated(
    model: type[S],
    values: dict[str, Any],
    where: str = "",
    document: str = "docs/settings.md",
    keys: Sequence[str] = (),
) -> S:
    """Validates `values` as `model`.

    Raises ConfigError: one line that begins with `where` and names each invalid key, its value and the allowed range.
    For unknown and missing keys it refers to `document`, or gives all `keys`.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        sentences = (_sentence(item, document, ", ".join(keys), model.model_fields) for item in error.errors())
        raise ConfigError(where + "; ".join(sentences)) from None


def quoted(value: Any) -> str:
    """A value, truncated to MAX_QUOTED characters."""
    text = repr(value)
    return text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}…"


_YAML_KINDS = {bool: "true or false", int: "a number", float: "a number", date: "a date", type(None): "nothing"}
"""What YAML makes of on and no, 0061 and 12:30:45, 1_0.5, 2024-05-01, and ~."""


def not_text(value: Any, what: str, note: str = "") -> str:
    """The message where YAML made another `value` of `what` should be text."""
    kind = next((kind for known, kind in _YAML_KINDS.items() if isinstance(value, known)), None)
    if kind is None:
        return f"{what} must be text, not {quoted(value)}"
    return f"{what} is {kind} to YAML{note}: write it in quotes, as it stands in the file"


def _sentence(item: Mapping[str, Any], document: str, keys: str, sections: Collection[str]) -> str:
    """One error of pydantic as a sentence; `sections` are the keys of the top level."""
    key, value = ".".join(str(part) for part in item["loc"] if "[" not in str(part)), quoted(item["input"])
    message = item["msg"].removeprefix("Value error, ")
    if not key:
        return message
    if item["type"] == "invalid_key" or item["loc"][-1] == "[key]":
        above = ".".join(map(str, item["loc"][: -1 if item["type"] == "invalid_key" else -2]))
        where = f"'{above}'" if above else "the top level"
        return f"{where} has the key {value}: {not_text(item['input'], 'this key')}"
    if item["type"] == "string_type":
        return f"'{key}' is {value}: {not_text(item['input'], 'this text')}"
    if item["type"] in ("list_type", "tuple_type"):
        return f"'{key}' is {value}: it must be a list" + (f": [{value}]" if isinstance(item["input"], str) else "")
    if item["type"] == "extra_forbidden" and keys:
        return f"unknown key '{key}'; there are: {keys}"
    if item["type"] == "extra_forbidden" and item["loc"][-1] in sections:
        above = ".".join(map(str, item["loc"][:-1]))
        alone = f", or under '{above}.overrides' for '{above}' alone" if item["loc"][0] in OVERRIDING else ""
        return f"'{key}' does not belong there: '{item['loc'][-1]}' stands at the top level{alone}"
    if item["type"] == "extra_forbidden":
        return f"unknown key '{key}' (value {value}): check its spelling against {document}"
    if item["type"] == "missing":
        return f"'{key}' is missing; there are: {keys}" if keys else f"'{key}' is missing: {document} says what it is"
    if item["type"] in ("dict_type", "model_type", "model_attributes_type"):
        return f"'{key}' is {value}: it must be a mapping, a key and a value for each entry; see {document}"
    return f"'{key}' is {value}: {message[:1].lower()}{message[1:]}"
