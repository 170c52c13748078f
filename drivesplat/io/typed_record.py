"""Dataclasses as the plain data of a file, and made of it once it fits their annotations."""

import dataclasses
import types
import typing
from enum import Enum
from functools import cache
from typing import Any, TypeVar

import numpy as np

R = TypeVar("R")
_hints = cache(typing.get_type_hints)


def field_values(record: Any) -> dict[str, Any]:
    """The fields of a dataclass by name; nested dataclasses stay what they are."""
    return {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}


def typed_record(kind: type[R], values: Any, json: bool = False) -> R:
    """The dataclass `kind` with the `values` (by name) of its fields; further values are ignored. As its
    annotation says, a dict becomes a dataclass, also within lists and tuples, a list a tuple, and a string a member of
    an enum. For values from `json` a list also becomes an array, and further values are an error.

    Raises ValueError where a field without a default value is missing, a value has another type, dtype or shape than
    the field's annotation, a number is not finite, the provenance is none, or the record's own `fault` names one. A
    dimension has one size in all arrays of the record. Elements of containers are not checked.
    """
    if not isinstance(values, dict):
        raise ValueError(f"it holds a {type(values).__name__}, no record")
    fields, hints = dataclasses.fields(kind), _hints(kind)
    lacking = [field.name for field in fields if field.default is dataclasses.MISSING and field.name not in values]
    if lacking:
        raise ValueError(f"it lacks {', '.join(lacking)}")
    if json and values.keys() - hints.keys():
        raise ValueError(f"it has another key {min(values.keys() - hints.keys())!r}")
    known = {name: _value(hints[name], values[name], json) for name in hints if name in values}
    sizes: dict[str, int] = {}
    for name, value in known.items():
        members = (typing.get_origin(member) or member for member in _members(hints[name]))
        classes = tuple(member if isinstance(member, type) else object for member in members)
        if not isinstance(value, classes) or not _fits(value, classes, sizes):
            found = f"{value.dtype} {list(value.shape)}" if hasattr(value, "dtype") else f"a {type(value).__name__}"
            raise ValueError(f"{name} is {found}, not {getattr(hints[name], '__name__', hints[name])}")
        require_finite(name, value)
    if "provenance" in known:
        lacking = [name for name in ("stages", "inputs") if not isinstance(known["provenance"].get(name), dict)]
        if lacking:  # later stages merge them
            raise ValueError(f"its provenance lacks {', '.join(lacking)}")
    record = kind(**known)
    if hasattr(record, "fault") and (fault := record.fault()):
        raise ValueError(fault)
    return record


def require_finite(name: str, value: Any) -> None:
    """Raises ValueError where the number or array `value` called `name` has NaN or infinity."""
    numbers = np.asarray(value) if isinstance(value, float | np.ndarray) else np.empty(0)
    if numbers.dtype.kind == "f" and numbers.size and not np.isfinite([numbers.min(), numbers.max()]).all():
        raise ValueError(f"{name} is not finite")


def _value(hint: Any, value: Any, json: bool) -> Any:
    """A plain value as an annotation has it; unchanged where the annotation does not fit."""
    for member in _members(hint):
        origin = typing.get_origin(member) or member
        if dataclasses.is_dataclass(origin) and value is not None:
            return typed_record(origin, value, json)
        if origin in (list, tuple) and isinstance(value, (list, tuple)):
            return origin(_value(typing.get_args(member)[0], item, json) for item in value)
        if json and isinstance(value, list) and getattr(origin, "array_type", None) is np.ndarray:
            return np.array(value, dtype=origin.dtypes[0])
        if isinstance(origin, type) and issubclass(origin, Enum):
            return origin(value)
    return value


def _members(hint: Any) -> tuple[Any, ...]:
    """The members of a union; another annotation as its only one."""
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)


def _fits(value: Any, classes: tuple[type, ...], sizes: dict[str, int]) -> bool:
    """Whether the named dimensions of an array of one of the `classes` have the `sizes` known so far; adds new ones.
    jaxtyping's `jaxtyped` would compare them, too, but imports jax where it is installed, which takes a second."""
    for kind in classes:
        if hasattr(kind, "dim_str") and isinstance(value, kind):
            named = zip(kind.dim_str.split(), value.shape, strict=True)
            return all(sizes.setdefault(dim, size) == size for dim, size in named if dim.isidentifier())
    return True
