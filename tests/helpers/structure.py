"""The structure of the library: its modules, packages and imports, and the figures that describe its size.

`PYTHONPATH=tests python -m helpers.structure` prints the figures.
"""

import ast
import functools
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from graphlib import TopologicalSorter
from pathlib import Path

from helpers import REPOSITORY
from helpers.syntax_trees import source_of, statements, tree_of

LIBRARY = "drivesplat"
FUNCTIONS = ast.FunctionDef | ast.AsyncFunctionDef
NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
}  # fmt: skip
SMALL = 60
"""Lines below which a module should have two importers."""
CORE_CLASSES = ("Part", "Actors", "SplatModel")

Graph = dict[str, set[str]]
"""What each module or package imports."""


@functools.cache
def modules() -> dict[str, Path]:
    """The library's modules by dotted name; a package is named without `__init__`."""
    files = (path for path in (REPOSITORY / LIBRARY).rglob("*.py") if "__pycache__" not in path.parts)
    paths = {path.relative_to(REPOSITORY).with_suffix(""): path for path in files}
    return {".".join(name.parts).removesuffix(".__init__"): path for name, path in paths.items()}


@functools.cache
def packages(*folders: str) -> dict[str, Path]:
    """The packages of some folders of the repository by dotted name, with their `__init__` files."""
    files = (path for folder in folders for path in (REPOSITORY / folder).rglob("__init__.py"))
    return {".".join(path.parent.relative_to(REPOSITORY).parts): path for path in sorted(files)}


def imported(tree: ast.AST, known: Iterable[str]) -> set[str]:
    """Modules of `known` that a syntax tree imports anywhere, also inside functions."""
    names: set[str] = set()
    for node in statements(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            paths = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            names |= {path if path in known else node.module for path in paths.values()}
    return names & set(known)


@functools.cache
def module_graph() -> Graph:
    files = modules()
    return {name: imported(tree_of(path), files.keys()) - {name} for name, path in files.items()}


def top(module: str) -> str:
    """The place directly in the library that holds a module."""
    return [*module.split("."), "__init__"][1]


def is_within(module: str, package: str) -> bool:
    return f"{module}.".startswith(f"{package}.")


def sibling_graph(graph: Graph, package: str) -> Graph:
    """The imports between the modules and packages directly in a package. `__main__` is a command that nothing imports:
    it may use packages above its own."""

    def place(module: str) -> str:
        return ".".join(module.split(".")[: package.count(".") + 2]) if module != package else f"{package}.__init__"

    siblings: Graph = {}
    for module, others in graph.items():
        if is_within(module, package) and not module.endswith(".__main__"):
            own = siblings.setdefault(place(module), set())
            own |= {place(other) for other in others if is_within(other, package)} - {place(module)}
    return siblings


def package_graph(graph: Graph, known: Iterable[str]) -> Graph:
    """The imports between packages at any depth, without those between a package and one around it: modules directly in
    a package may stand above its sub-packages and below them, which `sibling_graph` tells apart. A module directly in
    the library, such as `errors`, counts as a package."""

    def holder(module: str) -> str:
        return module if module in known or module.count(".") < 2 else module.rpartition(".")[0]

    found: Graph = {}
    for module, others in graph.items():
        if not module.endswith(".__main__"):
            own = holder(module)
            near = {other for other in map(holder, others) if is_within(other, own) or is_within(own, other)}
            found.setdefault(own, set()).update({*map(holder, others)} - near)
    return found


def longest_chain(graph: Graph) -> list[str]:
    """The longest path of imports, from the top down. Raises CycleError, with the circle, where there is one."""
    chains: dict[str, list[str]] = {}
    for module in TopologicalSorter(graph).static_order():
        below = max((chains[other] for other in graph.get(module, ())), key=len, default=[])
        chains[module] = [module, *below]
    return max(chains.values(), key=len, default=[])


def classes() -> Iterator[tuple[str, ast.ClassDef]]:
    """Every class of the library, with its module."""
    for module, path in modules().items():
        yield from ((module, node) for node in statements(tree_of(path)) if isinstance(node, ast.ClassDef))


def code_lines(source: str) -> int:
    """The lines of a source that are neither blank nor comment nor docstring."""
    texts = (node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Expr))
    strings = (text for text in texts if isinstance(text, ast.Constant) and isinstance(text.value, str))
    docstrings = {line for text in strings for line in range(text.lineno, text.end_lineno + 1)}
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    lines = (range(token.start[0], token.end[0] + 1) for token in tokens if token.type not in NO_CODE)
    return len({line for span in lines for line in span} - docstrings)


def small_modules() -> list[str]:
    """Modules under SMALL lines that one other module, script or rule imports. `__init__` and `__main__` are not
    counted."""
    importers = Counter(other for others in module_graph().values() for other in others)
    files = modules()
    for script in (REPOSITORY / "workflow_scripts").glob("*.py"):
        importers.update(imported(tree_of(script), files.keys()))
    for rules in (REPOSITORY / "Snakefile", *(REPOSITORY / "rules").glob("*.smk")):
        lines = re.findall(r"^(?:from|import) drivesplat.*", source_of(rules), re.MULTILINE)
        importers.update(imported(ast.parse("\n".join(lines)), files.keys()))
    small = (name for name, path in files.items() if len(source_of(path).splitlines()) < SMALL)
    return sorted(name for name in small if importers[name] == 1 and not files[name].stem.startswith("__"))


def figures() -> dict[str, float]:
    """The figures of the structure by their descriptions."""
    library = [source_of(path) for path in modules().values()]
    texts = {
        folder: sum(len(source_of(path).splitlines()) for path in (REPOSITORY / folder).rglob(pattern))
        for folder, pattern in (("tests", "*.py"), ("docs", "*.md"))
    }
    code = sum(map(code_lines, library))
    functions = [
        node for path in modules().values() for node in statements(tree_of(path)) if isinstance(node, FUNCTIONS)
    ]
    members = {node.name: sum(isinstance(item, FUNCTIONS) for item in node.body) for _, node in classes()}
    graph = module_graph()
    return {
        f"lines of {LIBRARY}": sum(len(source.splitlines()) for source in library),
        "lines of tests": texts["tests"],
        "lines of docs": texts["docs"],
        "lines of config.yaml": len(source_of(REPOSITORY / "config.yaml").splitlines()),
        "modules": len(library),
        f"modules under {SMALL} lines with one importer": len(small_modules()),
        "lines of code": code,
        "functions": len(functions),
        "lines of code per function": round(code / len(functions), 2),
        **{f"members of {name}": members[name] for name in CORE_CLASSES},
        "longest chain of packages": len(longest_chain(package_graph(graph, packages(LIBRARY)))),
        "longest chain of modules": len(longest_chain(graph)),
    }


if __name__ == "__main__":
    for description, value in figures().items():
        print(f"{value:>10} {description}")
