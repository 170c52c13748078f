"""Strict reading of users' YAML files. This module imports quickly, since the Snakefile imports it."""

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from drivesplat.errors import ConfigError
from drivesplat.io.regular_file import regular_file

MAX_BYTES = 2_000_000
"""Maximum size of a YAML file: PyYAML reads about 0.1 MB per second."""


def read_yaml(path: str | Path, what: str) -> Any:
    """The content of a YAML file.

    Raises ConfigError, one line with the file, its line and `what` it is, where it cannot be read, is no regular file,
    is not YAML, or has a duplicate key.
    """
    try:
        text = regular_file(path, MAX_BYTES).read_text(encoding="utf-8")
        return yaml.load(text, Loader=_EveryKeyOnce)  # a SafeLoader
    except OSError as error:
        raise ConfigError(f"{path}: the {what} cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: the {what} is not UTF-8 text ({error.reason})") from None
    except RecursionError:
        raise ConfigError(f"{path}: the {what} is nested too deeply") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{path}{line}: not YAML: {getattr(error, 'problem', None) or error}") from None


class _EveryKeyOnce(yaml.SafeLoader):
    """A safe loader that refuses duplicate keys, of which plain YAML silently drops the first, and names the line of a
    value that looks like a date or a number and is none."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep=True)  # not deep, it would make circles of aliases
        except (AttributeError, KeyError, ValueError) as error:
            kind = node.tag.rpartition(":")[2]
            problem = f"{str(node.value)[:80]!r} cannot be read as {kind} ({error}); quote text"
            raise yaml.constructor.ConstructorError(problem=problem, problem_mark=node.start_mark) from None

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        known: set[Any] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                continue  # refused below
            if key in known:
                raise yaml.constructor.ConstructorError(
                    problem=f"the key {key!r} stands twice", problem_mark=key_node.start_mark
                )
            known.add(key)
        return super().construct_mapping(node, deep)
