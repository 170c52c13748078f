"""What makes a rerun exact: a digest of the code a stage runs, blind to comments, docstrings, layout and file times.

Snakemake compares a rule's `params`; this digest and the stage's canonical settings are two of them (rules/common.smk).
"""

import hashlib
from collections.abc import Iterator
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

from drivesplat.provenance.syntax_digest import Meaning, meanings

PACKAGE = "drivesplat"
PACKAGE_FOLDER = Path(__file__).parents[1]
PAGE_FILES = (".html", ".js")
"""What decides a result, too, where it lies beside a package's modules."""


def code_digest(script: str | Path) -> str:
    """A hash of the meaning of a script and of every module of this package it imports, directly or through others.

    The meaning is the syntax tree without bare strings (docstrings, field comments). Imports inside functions count.
    Scripts and pages that lie in a package (viewer.html's) are part of it, every byte.
    """
    path = Path(script)
    modules, waiting = {}, set(_imports(path, package=""))
    while waiting:
        name = waiting.pop()
        if name not in modules:
            file = _file_of(name)
            modules[name] = _content(file)
            waiting |= _imports(file, package=name if file.name == "__init__.py" else name.rpartition(".")[0])
    content = [_content(path), *(f"{name}\n{modules[name]}" for name in sorted(modules))]
    meanings(PACKAGE_FOLDER / "__pycache__").remember()
    return hashlib.sha256("\n\n".join(content).encode()).hexdigest()


@cache
def _meaning(path: Path) -> Meaning:
    return meanings(PACKAGE_FOLDER / "__pycache__").of(path)


@cache
def _content(path: Path) -> str:
    """Digests of all that decides a result in a file, and in what lies beside it where it opens a package."""
    digest = _meaning(path).digest
    if path.name != "__init__.py":
        return digest
    others = sorted(file for kind in PAGE_FILES for file in path.parent.glob(f"[!.]*{kind}"))
    return "\n".join([digest, *(f"{file.name} {hashlib.sha256(file.read_bytes()).hexdigest()}" for file in others)])


@cache
def _imports(path: Path, package: str) -> frozenset[str]:
    """The modules of this package that a file names, packages on the way to them included."""
    parts = [name.split(".") for name in _absolute(_meaning(path).names, package)]
    candidates = {".".join(p[: i + 1]) for p in parts if p[0] == PACKAGE for i in range(len(p))}
    return frozenset(name for name in candidates if _file_of(name) is not None)


def _absolute(names: tuple[str, ...], package: str) -> Iterator[str]:
    return (resolve_name(name, package) if name.startswith(".") else name for name in names)


@cache
def _file_of(module: str) -> Path | None:
    base = PACKAGE_FOLDER.joinpath(*module.split(".")[1:])
    for file in (base / "__init__.py", base.with_suffix(".py")):
        if file.is_file() and file.stem.isidentifier():
            return file
    return None
