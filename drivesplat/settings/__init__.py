"""The base class of all settings records, and one-line messages for their errors.

Fields are documented by attribute docstrings, so that a reworded comment does not change the code digest (see
`drivesplat.provenance.code_digest`).
"""

from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from drivesplat.errors import ConfigError

S = TypeVar("S", bound="Settings")
MAX_QUOTED = 80
"""Maximum number of characters of a value in a message."""


class Settings(BaseModel):
    """Immutable settings: unknown keys are refused, field docstrings are the documentation."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True, protected_namespaces=()
    )

    @field_validator("*", mode="before")
    @classmethod
    def _no_text_for_numbers(cls, value: Any, info: Any) -> Any:
        kinds = cls.model_fields[info.field_name].annotation
        wanted = {kinds, *get_args(kinds)} & {int, float, bool}
        if wanted == {bool} and not isinstance(value, bool):
            raise ValueError("input should be true or false")
        if wanted and wanted != {bool} and isinstance(value, (str, bool)):
            raise ValueError("input should be a number (YAML reads 1e-3 as text: write 1.0e-3)")
        return value


def validated(model: type[S], values: dict[str, Any], where: str, document: str = "config.yaml") -> S:
    """Validates `values`, which `document` describes, as `model`.

    Raises ConfigError: one line that names each invalid key, with `where` before it, its value and the allowed range.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError("; ".join(_sentence(item, where, document) for item in error.errors())) from None


def _quoted(value: Any) -> str:
    """A value, truncated to MAX_QUOTED characters."""
    text = repr(value)
    return text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}…"


def _sentence(item: dict[str, Any], where: str, document: str) -> str:
    if not item["loc"]:
        return where + item["msg"].removeprefix("Value error, ")
    key = where + ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        return f"unknown key '{key}' (value {_quoted(item['input'])}): check its spelling against {document}"
    if item["type"] == "missing":
        return f"'{key}' is missing: {document} says what it is"
    message = item["msg"].removeprefix("Value error, ")
    return f"'{key}' is {_quoted(item['input'])}: {message[:1].lower()}{message[1:]}"
