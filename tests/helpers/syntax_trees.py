"""Python files of the project, each read and parsed once for all tests that look at them."""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path


@functools.cache
def source_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@functools.cache
def tree_of(path: Path) -> ast.Module:
    """The syntax tree of a file; not to be changed."""
    return ast.parse(source_of(path))


def statements(tree: ast.AST) -> Iterator[ast.AST]:
    """A tree and all statements in it, at any depth."""
    waiting = [tree]
    while waiting:
        yield (node := waiting.pop())
        for name in ("body", "orelse", "finalbody", "handlers", "cases"):
            waiting += getattr(node, name, ())
