"""Tokens of the records of a synthetic world."""

import hashlib
from typing import Any


def token(*name: Any) -> str:
    """The token of a record: 32 hexadecimal digits of a hash of its name."""
    return hashlib.sha256(" ".join(map(str, name)).encode()).hexdigest()[:32]


def instance_token(scene: str, name: str) -> str:
    """The token of the object `name`, which is the id of its track."""
    return token(scene, "instance", name)
