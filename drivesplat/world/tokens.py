"""Tokens of the objects of a synthetic world."""

from drivesplat.readers.nuscenes.tokens import token


def instance_token(scene: str, name: str) -> str:
    """The token of the object `name`, which is the id of its track."""
    return token(scene, "instance", name)
