"""Unique names of groups in the syntax of other programs, and as files."""

import re
from collections.abc import Callable, Iterable


def unique_names(
    names: Iterable[str], to_identifier: Callable[[str], str], taken: Iterable[str] = ()
) -> dict[str, str]:
    """Identifiers of `names`, made by `to_identifier`, unique regardless of case and different from those `taken`.

    Of equal identifiers the first is unchanged; the others end in _2, _3, ...
    """
    used = {word.casefold() for word in taken}
    identifiers = {}
    for name in names:
        word, number = to_identifier(name), 1
        while word.casefold() in used:
            number += 1
            word = f"{to_identifier(name)}_{number}"
        used.add(word.casefold())
        identifiers[name] = word
    return identifiers


def file_stems(names: Iterable[str]) -> dict[str, str]:
    """Unique names of files for `names` that are valid on every system, without suffix."""
    return unique_names(names, lambda name: re.sub(r"[^A-Za-z0-9_-]", "_", name) or "_")
