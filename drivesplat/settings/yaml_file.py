"""Strict reading of users' YAML files. This module imports quickly, since the Snakefile imports it."""

from pathlib import Path
from typing import Any

import yaml

from drivesplat.errors import ConfigError


def read_yaml(path: str | Path, what: str) -> Any:
    """The content of a YAML file.

    Raises ConfigError, one line with the file, its line and `what` it is, where it cannot be read, is not YAML, or has
    a duplicate key.
    """
    try:
        return yaml.load(Path(path).read_text(encoding="utf-8"), Loader=_EveryKeyOnce)  # a SafeLoader
    except OSError as error:
        raise ConfigError(f"{path}: the {what} cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: the {what} is not UTF-8 text ({error.reason})") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{path}{line}: not YAML: {getattr(error, 'problem', None) or error}") from None


class _EveryKeyOnce(yaml.SafeLoader):
    """A safe loader that refuses duplicate keys, of which plain YAML silently drops the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        known: list[Any] = []
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if key in known:
                raise yaml.constructor.ConstructorError(
                    problem=f"the key {key!r} stands twice", problem_mark=key_node.start_mark
                )
            known.append(key)
        return super().construct_mapping(node, deep)
