"""The checks of types and shapes that the tests switch on, made once for each nested function."""

from collections.abc import Callable
from typing import Any

from beartype import beartype
from jaxtyping import install_import_hook

_CHECKED: dict[tuple, Callable[..., Any]] = {}


def check_types_of(package: str) -> None:
    """Checks arguments and results of all functions of a package that is not imported yet."""
    install_import_hook(package, f"{__name__}.{checked.__name__}")


def checked(signature: Callable[..., Any]) -> Callable[..., Any]:
    """beartype's check of a signature, which jaxtyping gives as a function without content.

    A nested function is decorated at every call of the function around it. To compile each check would take 40 % of
    the time of a small training, so nested functions of the same name with equal annotations share theirs.
    """
    if "<locals>" not in signature.__qualname__ or signature.__defaults__ or signature.__kwdefaults__:
        return beartype(signature)
    code, annotations = signature.__code__, tuple(signature.__annotations__.items())
    key = (signature.__module__, signature.__qualname__, code.co_varnames, code.co_flags, code.co_code, annotations)
    try:
        found = _CHECKED.get(key)
    except TypeError:  # an annotation without hash
        return beartype(signature)
    if found is None:
        found = _CHECKED[key] = beartype(signature)
    return found
