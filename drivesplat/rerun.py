"""What makes a rerun exact: a digest of the code a stage runs, blind to comments, docstrings, layout and file times.

Snakemake compares a rule's `params`; this digest and the stage's canonical settings are two of them (rules/common.smk).
"""

import ast
import hashlib
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

PACKAGE = "drivesplat"
PACKAGE_FOLDER = Path(__file__).parent
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
            modules[name] = _meaning(file)
            waiting |= _imports(file, package=name if file.name == "__init__.py" else name.rpartition(".")[0])
    content = [_meaning(path), *(f"{name}\n{modules[name]}" for name in sorted(modules))]
    return hashlib.sha256("\n\n".join(content).encode()).hexdigest()


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


@cache
def _meaning(path: Path) -> str:
    code = ast.unparse(_WithoutBareStrings().visit(ast.parse(path.read_text(encoding="utf-8"))))
    if path.name != "__init__.py":
        return code
    others = sorted(file for kind in PAGE_FILES for file in path.parent.glob(f"[!.]*{kind}"))
    return "\n".join([code, *(f"{file.name} {hashlib.sha256(file.read_bytes()).hexdigest()}" for file in others)])


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


@cache
def _imports(path: Path, package: str) -> frozenset[str]:
    """The modules of this package that a file imports, packages on the way to them included."""
    names: set[str] = set()
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), package) if node.level else node.module
            names.update([base, *(f"{base}.{alias.name}" for alias in node.names)])
        elif isinstance(node, ast.Constant) and _names_a_module(node.value):
            names.add(node.value)
    parts = (name.split(".") for name in names if name.split(".")[0] == PACKAGE)
    candidates = {".".join(p[: i + 1]) for p in parts for i in range(len(p))}
    return frozenset(name for name in candidates if _file_of(name) is not None)


def _names_a_module(value: object) -> bool:
    """Whether a string constant spells a module of this package: modules imported by name."""
    return isinstance(value, str) and value.startswith(f"{PACKAGE}.") and _file_of(value) is not None


@cache
def _file_of(module: str) -> Path | None:
    base = PACKAGE_FOLDER.joinpath(*module.split(".")[1:])
    for file in (base / "__init__.py", base.with_suffix(".py")):
        if file.is_file() and file.stem.isidentifier():
            return file
    return None
