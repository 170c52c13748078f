"""The digest of the code that a stage runs, by its syntax trees: comments, docstrings, layout, file times and the
Python version do not change it.

Snakemake compares a rule's `params`; this digest and the stage's canonical settings are two of them (rules/common.smk).
The digest of a file follows from its bytes alone, and is cached: planning the workflow needs those of all modules.
"""

import ast
import hashlib
import json
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.util import cache_from_source, resolve_name
from pathlib import Path
from typing import Any

PACKAGE = "drivesplat"
PACKAGE_FOLDER = Path(__file__).parents[2]
PAGE_FILES = (".html", ".js")
"""Files beside a package's modules that are part of the package's code."""
IGNORED_FIELDS = ("kind", "ctx")
"""Fields of syntax nodes that say how a string was spelled, or repeat what the parent node says."""


@dataclass(frozen=True)
class SyntaxDigest:
    """A file's digest and the modules it may import."""

    digest: str
    """SHA-256 of the canonical syntax tree without bare strings."""
    names: tuple[str, ...]
    """Possible modules, sorted: imported names, relative to the file's package where they begin with dots, and string
    constants that spell dotted names, where `*` stands for any name."""


def cached_digest(file: Path) -> SyntaxDigest:
    """The digest of a file, cached beside it as bytecode is. Raises SyntaxError where it is not Python."""
    content = file.read_bytes()
    key = hashlib.sha256(_own_content() + content).hexdigest()
    cache = file.parent / "__pycache__" / f"{file.stem}.syntax.json"
    with suppress(OSError, ValueError, TypeError):  # absent, truncated or foreign: computed again
        known, digest, names = json.loads(cache.read_text(encoding="utf-8"))
        if known == key:
            return SyntaxDigest(digest, tuple(names))
        # Python takes bytecode for that of any content of the same size and second.
        Path(cache_from_source(str(file))).unlink(missing_ok=True)
    found = syntax_digest(content)
    with suppress(OSError):
        cache.parent.mkdir(exist_ok=True)
        cache.write_text(json.dumps([key, found.digest, found.names]), encoding="utf-8")
    return found


def code_digest(script: str | Path) -> str:
    """A hash of the syntax of a script and of every module of this package that it imports, directly or indirectly.

    Bare strings (docstrings, field comments) do not count, imports inside functions do, and so do the modules that a
    string spells, all of them where it has a `*` for a name. JavaScript and HTML files in a
    package (the viewer's) are part of it, byte by byte.
    """
    path = Path(script)
    content = [_content(path), *(f"{name}\n{_content(file)}" for name, file in sorted(_modules(path).items()))]
    return hashlib.sha256("\n\n".join(content).encode()).hexdigest()


def code_files(script: str | Path) -> tuple[list[Path], list[Path]]:
    """The modules of this package that `code_digest` covers, and the pages and scripts beside them."""
    modules = list(_modules(Path(script)).values())
    return modules, [page for file in modules for page in _pages(file)]


@cache
def _modules(script: Path) -> dict[str, Path]:
    """The modules of this package that a script imports, directly or indirectly, by name."""
    modules: dict[str, Path] = {}
    waiting = set(_imports(script, package=""))
    while waiting:
        name = waiting.pop()
        if name not in modules:
            modules[name] = file = _file_of(name)
            waiting |= _imports(file, package=name if file.name == "__init__.py" else name.rpartition(".")[0])
    return modules


_syntax = cache(cached_digest)


@cache
def _content(path: Path) -> str:
    """The digest of a module; for a package also those of its pages and scripts."""
    pages = (f"{file.name} {hashlib.sha256(file.read_bytes()).hexdigest()}" for file in _pages(path))
    return "\n".join([_syntax(path).digest, *pages])


def _pages(path: Path) -> list[Path]:
    """The pages and scripts beside the modules of a package, given its `__init__.py`."""
    if path.name != "__init__.py":
        return []
    return sorted(file for kind in PAGE_FILES for file in path.parent.glob(f"[!.]*{kind}"))


@cache
def _imports(path: Path, package: str) -> frozenset[str]:
    """The modules of this package that a file names, with the packages that contain them."""
    names = (resolve_name(name, package) if name.startswith(".") else name for name in _syntax(path).names)
    parts = [name.split(".") for pattern in names for name in expanded(pattern)]
    candidates = {".".join(p[: i + 1]) for p in parts if p[0] == PACKAGE for i in range(len(p))}
    return frozenset(name for name in candidates if _file_of(name) is not None)


def expanded(pattern: str) -> list[str]:
    """The modules of this package that fit a pattern of dotted names; a name without `*` is itself."""
    first, *rest = pattern.split(".")
    if "*" not in pattern or first != PACKAGE:
        return [pattern]
    files = PACKAGE_FOLDER.glob("/".join(rest) + ".py")
    return [".".join((PACKAGE, *file.relative_to(PACKAGE_FOLDER).with_suffix("").parts)) for file in files]


@cache
def _file_of(module: str) -> Path | None:
    base = PACKAGE_FOLDER.joinpath(*module.split(".")[1:])
    for file in (base / "__init__.py", base.with_suffix(".py")):
        if file.is_file() and file.stem.isidentifier():
            return file
    return None


@cache
def _own_content() -> bytes:
    """This module: another version of it may compute other digests."""
    return Path(__file__).read_bytes()


def syntax_digest(content: bytes) -> SyntaxDigest:
    """The digest of a file with this content. Raises SyntaxError where it is not Python."""
    tree, names = ast.parse(content), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            dot = "" if base.endswith(".") else "."
            names |= {base, *(f"{base}{dot}{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            # a string constant may be a module that is imported by its name
            parts = node.value.split(".")
            names |= {node.value} if len(parts) > 1 and all(p.isidentifier() or p == "*" for p in parts) else set()
    return SyntaxDigest(hashlib.sha256(canonical_tree(tree).encode()).hexdigest(), tuple(sorted(names)))


def canonical_tree(node: Any) -> str:
    """A syntax tree as text that is the same whichever Python version parsed the source.

    Empty fields are left out, so that fields which later versions add change nothing. Adjacent constants of an f-string
    are merged: versions differ in where they split them.
    """
    if isinstance(node, list):
        return f"[{','.join(map(canonical_tree, node))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    written = []
    for name in node._fields:
        value = getattr(node, name, None)
        if isinstance(node, ast.JoinedStr):
            value = list(_merged_constants(value))
        elif name == "body" and isinstance(value, list):
            value = [statement for statement in value if not _is_bare_string(statement)] or [ast.Pass()]
        if name not in IGNORED_FIELDS and value is not None and value != []:
            written.append(f"{name}={canonical_tree(value)}")
    return f"{type(node).__name__}({','.join(written)})"


def _merged_constants(values: Iterable[ast.expr]) -> Iterator[ast.expr]:
    """The values of an f-string without empty constants, with adjacent constants and nested f-strings joined."""
    text = ""
    for value in _flat(values):
        if isinstance(value, ast.Constant):
            text += value.value
            continue
        if text:
            yield ast.Constant(text)
        text = ""
        yield value
    if text:
        yield ast.Constant(text)


def _flat(values: Iterable[ast.expr]) -> Iterator[ast.expr]:
    for value in values:
        if isinstance(value, ast.JoinedStr):
            yield from _flat(value.values)
        else:
            yield value


def _is_bare_string(statement: ast.AST) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )
