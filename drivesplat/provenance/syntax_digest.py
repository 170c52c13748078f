"""What a source file says: its syntax tree without comments, docstrings and layout, and the modules that it names.

Both follow from the file's bytes alone, and are remembered by them: a plan of the workflow asks for some 200 files.
"""

import ast
import hashlib
import json
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from drivesplat.errors import ResultError
from drivesplat.io.storage import atomic_write

KEPT = 5000
"""How many files' meanings are remembered before those not asked for are forgotten; about 300 bytes each."""


@dataclass(frozen=True)
class Meaning:
    """What a file says."""

    digest: str
    """Of its syntax tree without bare strings."""
    names: tuple[str, ...]
    """What may be modules, sorted: what is imported, relative to the file's package where it begins with dots, and the
    string constants that spell dotted names."""


class Meanings:
    """The meanings of files, remembered on disk at `path` where that can be written."""

    def __init__(self, path: Path):
        self._path = path
        self._known: dict[str, Meaning] = {}
        with suppress(OSError, ValueError, TypeError, AttributeError):  # absent, torn or foreign: found anew
            stored = json.loads(path.read_text(encoding="utf-8"))
            self._known = {key: Meaning(digest, tuple(names)) for key, (digest, names) in stored.items()}
        self._asked: set[str] = set()
        self._new = False

    def of(self, file: Path) -> Meaning:
        """The meaning of a file. Raises SyntaxError where it is no Python."""
        content = file.read_bytes()
        key = hashlib.sha256(content).hexdigest()
        self._asked.add(key)
        if key not in self._known:
            self._known[key] = meaning(content)
            self._new = True
        return self._known[key]

    def remember(self) -> None:
        """Writes what has been found anew."""
        if not self._new:
            return
        if len(self._known) > KEPT:
            self._known = {key: known for key, known in self._known.items() if key in self._asked}
        with suppress(ResultError), atomic_write(self._path) as file:
            file.write(json.dumps({key: (m.digest, m.names) for key, m in self._known.items()}).encode())
        self._new = False


@cache
def meanings(folder: Path) -> Meanings:
    """Those remembered in `folder`, for this Python and this way of reading."""
    reading = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:8]
    return Meanings(folder / f"meanings-{sys.implementation.cache_tag}-{reading}.json")


def meaning(content: bytes) -> Meaning:
    """The meaning of a file with this content. Raises SyntaxError where it is no Python."""
    tree = ast.parse(content)
    names = sorted(set(_names(tree)))
    code = ast.unparse(_WithoutBareStrings().visit(tree))
    return Meaning(hashlib.sha256(code.encode()).hexdigest(), tuple(names))


def _names(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            yield base
            yield from (f"{base}{'' if base.endswith('.') else '.'}{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _is_dotted(node.value):
            yield node.value


def _is_dotted(text: str) -> bool:
    """Whether a string constant may be a module that is imported by its name."""
    return "." in text and all(part.isidentifier() for part in text.split("."))


class _WithoutBareStrings(ast.NodeTransformer):
    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        if isinstance(getattr(node, "body", None), list):
            node.body = [s for s in node.body if not _is_bare_string(s)] or [ast.Pass()]
        return node


def _is_bare_string(statement: ast.AST) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )
