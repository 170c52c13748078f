"""The digest of the code that a stage runs: comments, docstrings, layout and file times do not change it.

Snakemake compares a rule's `params`; this digest and the stage's canonical settings are two of them (rules/common.smk).
"""

import hashlib
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

from drivesplat.provenance.code.syntax_digest import cached_digest

PACKAGE = "drivesplat"
PACKAGE_FOLDER = Path(__file__).parents[2]
PAGE_FILES = (".html", ".js")
"""Files beside a package's modules that are part of the package's code."""


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
