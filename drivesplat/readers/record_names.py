"""How messages name the records and values of a dataset. Planning imports this: nothing heavy."""

import reprlib
from typing import Any

MAX_TEXT = 1000
"""Maximum number of characters of a token or name."""


def shown(value: Any) -> str:
    """A value for a message, shortened."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 60
    return short.repr(value)


def named(table: str, token: Any) -> str:
    """The name of a table's record, for messages. Long tokens are shortened."""
    return f"{table} {token if isinstance(token, str) and token and not text_fault(token) else shown(token)}"


def text_fault(value: Any) -> str | None:
    """What a value should be that is no text of at most MAX_TEXT characters; None if it is."""
    if not isinstance(value, str):
        return "must be text"
    if len(value) > MAX_TEXT:
        return f"must have at most {MAX_TEXT} characters"
    return None if is_printable(value) else "must be valid Unicode without control characters"


def is_printable(text: str) -> bool:
    """Whether a text can be printed in a line and written to a file: no lone surrogates, no control characters."""
    return text.isprintable() or not any(ord(c) < 32 or 127 <= ord(c) < 160 or 0xD800 <= ord(c) < 0xE000 for c in text)


def counted(number: int, name: str, plural: str = "") -> str:
    """A number of things in words: '1 track', '2 tracks'."""
    return f"{number} {name if number == 1 else plural or f'{name}s'}"
