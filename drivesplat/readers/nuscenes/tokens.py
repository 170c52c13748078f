"""Tokens of rows that this project writes."""

import hashlib
from typing import Any


def token(*name: Any) -> str:
    """The token of a row: 32 hexadecimal digits of a hash of its name."""
    return hashlib.sha256(" ".join(map(str, name)).encode()).hexdigest()[:32]
