"""The checks of types and shapes that the tests switch on: of the first calls of a function in each test, and made once
for each nested function."""

from collections.abc import Callable
from functools import wraps
from types import CodeType, FunctionType
from typing import Any

import jaxtyping
from beartype import beartype

CHECKED_CALLS = 25
"""Of each function in each test. Further calls, which are those of loops, would take a third of the suite's time."""
_CHECKED: dict[tuple, Callable[..., Any]] = {}
_calls: dict[int, int] = {}
"""The calls in this test, by the id of the function's code, which nested functions share."""


def check_types_of(package: str) -> None:
    """Checks arguments and results of all functions of a package that is not imported yet."""
    jaxtyping.install_import_hook(package, f"{__name__}.{checked.__name__}")
    jaxtyping.jaxtyped = _in_first_calls(jaxtyping.jaxtyped)


def begin_test() -> None:
    """Calls count from here."""
    _calls.clear()


def _in_first_calls(jaxtyped: Callable) -> Callable:
    """jaxtyping's decorator, whose functions check their first calls. Other calls have letters of their own for lengths
    where they compare values with types, as the library does with fields of records."""
    own_letters = jaxtyped("context")

    def decorator(function: Any = None, *, typechecker: Any = None) -> Any:
        if function is not None:
            return jaxtyped(function, typechecker=typechecker)
        return lambda found: decorate(found, typechecker)

    def decorate(function: Any, typechecker: Any) -> Any:
        if not isinstance(function, FunctionType):
            return jaxtyped(function, typechecker=typechecker)
        code, whole, compares = id(function.__code__), None, _compares_types(function.__code__)

        @wraps(function)
        def called(*args: Any, **kwargs: Any) -> Any:
            nonlocal whole
            __tracebackhide__ = True
            count = _calls.get(code, 0)
            if count >= CHECKED_CALLS:
                if not compares:
                    return function(*args, **kwargs)
                with own_letters:
                    return function(*args, **kwargs)
            _calls[code] = count + 1
            whole = whole or jaxtyped(function, typechecker=typechecker)
            return whole(*args, **kwargs)

        return called

    return decorator


def _compares_types(code: CodeType) -> bool:
    """Whether a function, or one inside it, asks for the type of a value."""
    inside = (const for const in code.co_consts if isinstance(const, CodeType))
    return "isinstance" in code.co_names or any(map(_compares_types, inside))


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
