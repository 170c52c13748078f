"""The structure of the library: few places at its top, no import circles, bounded chains of imports."""

import ast
import functools
from graphlib import TopologicalSorter
from pathlib import Path

from helpers import REPOSITORY
from helpers.syntax_trees import source_of, tree_of

LIBRARY = "drivesplat"
MAX_PLACES, MAX_LOOSE_MODULES = 26, 2
MAX_PACKAGE_CHAIN, MAX_MODULE_CHAIN = 8, 18
MAX_LINES = 300

Graph = dict[str, set[str]]
"""What each module or package imports."""


@functools.cache
def modules() -> dict[str, Path]:
    """The library's modules by dotted name; a package is named without `__init__`."""
    files = (path for path in (REPOSITORY / LIBRARY).rglob("*.py") if "__pycache__" not in path.parts)
    paths = {path.relative_to(REPOSITORY).with_suffix(""): path for path in files}
    return {".".join(name.parts).removesuffix(".__init__"): path for name, path in paths.items()}


def imported(tree: ast.AST, known: set[str]) -> set[str]:
    """Modules of `known` that a syntax tree imports anywhere, also inside functions."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            paths = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            names |= {path if path in known else node.module for path in paths.values()}
    return names & known


@functools.cache
def module_graph() -> Graph:
    files = modules()
    return {name: imported(tree_of(path), set(files)) - {name} for name, path in files.items()}


def package_graph(graph: Graph) -> Graph:
    """The same between the places directly in the library. `__main__` is a command that nothing imports: it may use
    packages above its own."""
    packages: Graph = {}
    for module, others in graph.items():
        if module.endswith(".__main__"):
            continue
        place = top(module)
        packages.setdefault(place, set()).update(top(other) for other in others if top(other) != place)
    return packages


def top(module: str) -> str:
    """The place directly in the library that holds a module."""
    return [*module.split("."), "__init__"][1]


def longest_chain(graph: Graph) -> list[str]:
    """The longest path of imports, from the top down. Raises CycleError, with the circle, where there is one."""
    chains: dict[str, list[str]] = {}
    for module in TopologicalSorter(graph).static_order():
        below = max((chains[other] for other in graph[module]), key=len, default=[])
        chains[module] = [module, *below]
    return max(chains.values(), key=len)


def test_few_places_are_directly_in_the_library():
    packages = {path.parent.name for path in (REPOSITORY / LIBRARY).glob("*/*.py")}
    loose = {path.name for path in (REPOSITORY / LIBRARY).glob("*.py")}
    assert len(packages) + len(loose) <= MAX_PLACES
    assert len(loose) <= MAX_LOOSE_MODULES, loose


def test_modules_are_short():
    long = {name: lines for name in modules() if (lines := len(source_of(modules()[name]).splitlines())) > MAX_LINES}
    assert not long, "a concept is missing: move it to a module of its own"


def test_modules_import_in_no_circle_and_in_short_chains():
    chain = longest_chain(module_graph())
    assert len(chain) <= MAX_MODULE_CHAIN, " > ".join(chain)


def test_packages_import_in_no_circle_and_in_short_chains():
    chain = longest_chain(package_graph(module_graph()))
    assert len(chain) <= MAX_PACKAGE_CHAIN, " > ".join(chain)


def test_kernels_import_nothing_above_them():
    below = {"kernels", "provenance", "io", "errors"}
    assert {other for module, others in module_graph().items() if top(module) == "kernels" for other in others} <= {
        module for module in modules() if top(module) in below
    }


def test_only_kernels_choose_between_triton_numba_and_torch():
    """Callers use one function per operation: no import of a backend, no question which one is used."""
    backends = tuple(f"drivesplat.kernels.{name}." for name in ("cuda", "triton", "numba"))
    wrong = {
        module
        for module, others in module_graph().items()
        if top(module) != "kernels"
        and (any(f"{o}.".startswith(backends) for o in others) or "usable_for" in source_of(modules()[module]))
    }
    assert wrong == set()


def test_imports_are_found_in_every_form():
    source = "import a.b\nfrom a import b, c\nfrom a.b import d\ndef f():\n    from e import g\n"
    assert imported(ast.parse(source), {"a", "a.b", "e"}) == {"a", "a.b", "e"}
    assert longest_chain({"x": {"y"}, "y": {"z"}, "z": set(), "w": {"z"}}) == ["x", "y", "z"]


JSON_DOCUMENTS = {
    "read_backbone", "read_baselines", "read_evaluations", "read_record", "read_summary", "read_scene_tables",
}  # fmt: skip
"""Readers of JSON for users (train.json, eval.json, backbone.json, scan_baselines.json), of the dataset's tables, and
the one they share."""


def test_readers_of_intermediates_return_typed_records():
    untyped = {
        node.name
        for path in modules().values()
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.FunctionDef) and node.name.startswith("read_") and node.returns
        if "dict[str, Any]" in ast.unparse(node.returns)
    }
    assert untyped == JSON_DOCUMENTS | {"read_arrays"}, "a reader returns a dict; io/typed_record.py makes records"
