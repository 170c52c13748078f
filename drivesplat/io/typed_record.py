"""Dataclasses made of what a file holds, once it fits their annotations."""

import dataclasses
import types
import typing
from typing import Any, TypeVar

from jaxtyping import jaxtyped

R = TypeVar("R")


def typed_record(kind: type[R], values: Any) -> R:
    """The dataclass `kind` with the `values` (by name) of its fields; further values are ignored.

    Raises ValueError where a field without a default value is missing, or a value has another type, dtype or shape than
    the field's annotation. A dimension has one size in all arrays of the record. Elements of containers are not
    checked.
    """
    if not isinstance(values, dict):
        raise ValueError(f"it holds a {type(values).__name__}, no record")
    fields, hints = dataclasses.fields(kind), typing.get_type_hints(kind)
    lacking = [field.name for field in fields if field.default is dataclasses.MISSING and field.name not in values]
    if lacking:
        raise ValueError(f"it lacks {', '.join(lacking)}")
    known = {field.name: values[field.name] for field in fields if field.name in values}
    with jaxtyped("context"):  # which another checked function, called from here, would not see
        for name, value in known.items():
            if not isinstance(value, _classes(hints[name])):
                raise ValueError(f"{name} is {_described(value)}, not {getattr(hints[name], '__name__', hints[name])}")
    return kind(**known)


def _classes(hint: Any) -> tuple[type, ...]:
    """The classes that values of an annotation may have."""
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    members = (typing.get_origin(member) or member for member in (typing.get_args(hint) if union else (hint,)))
    return tuple(member if isinstance(member, type) else object for member in members)


def _described(value: Any) -> str:
    return f"{value.dtype} {list(value.shape)}" if hasattr(value, "dtype") else f"a {type(value).__name__}"
