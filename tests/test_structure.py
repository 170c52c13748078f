"""The structure of the library: few places at its top, no import circles, bounded chains of imports."""

import ast
import re
from collections import defaultdict
from graphlib import CycleError

import pytest
from helpers import REPOSITORY
from helpers.structure import (
    LIBRARY,
    classes,
    imported,
    longest_chain,
    module_graph,
    modules,
    package_graph,
    packages,
    sibling_graph,
    small_modules,
    top,
)
from helpers.syntax_trees import source_of, statements, tree_of

MAX_PLACES, MAX_LOOSE_MODULES = 27, 2
MAX_PACKAGE_CHAIN, MAX_MODULE_CHAIN = 9, 18
MAX_LINES = 400
MAX_SMALL_MODULES = 14
SIGNED = packages(LIBRARY, "benchmarks")


def test_few_places_are_directly_in_the_library():
    holding = {path.parent.name for path in (REPOSITORY / LIBRARY).glob("*/*.py")}
    loose = {path.name for path in (REPOSITORY / LIBRARY).glob("*.py")}
    assert len(holding) + len(loose) <= MAX_PLACES
    assert len(loose) <= MAX_LOOSE_MODULES, loose


def test_modules_are_short_and_packages_say_what_they_hold():
    long = {name: lines for name in modules() if (lines := len(source_of(modules()[name]).splitlines())) > MAX_LINES}
    assert not long, "a concept is missing: move it to a module of its own"
    assert len(small_modules()) <= MAX_SMALL_MODULES, "a small module of one user joins it, unless it is a concept"
    assert [package for package, path in SIGNED.items() if not ast.get_docstring(tree_of(path))] == []


def test_the_page_for_contributors_lists_every_package():
    page = (REPOSITORY / "docs/developing.md").read_text(encoding="utf-8")
    table = page[page.index("\n| package |") : page.index("\nRules, held by")]
    listed = re.findall(r"^\| `([\w/]+)` \|", table, re.MULTILINE)
    names = [name.replace(".", "/").removeprefix(f"{LIBRARY}/") for name in SIGNED if name != LIBRARY]
    assert sorted(listed) == sorted([*names, "errors"])


def test_modules_and_packages_at_any_depth_import_in_no_circle_and_in_short_chains():
    for graph, most in (
        (module_graph(), MAX_MODULE_CHAIN),
        (package_graph(module_graph(), packages(LIBRARY)), MAX_PACKAGE_CHAIN),
    ):
        chain = longest_chain(graph)
        assert len(chain) <= most, " > ".join(chain)
    for package in packages(LIBRARY):
        longest_chain(sibling_graph(module_graph(), package))  # raises CycleError with the circle


def test_circles_at_any_depth_are_found():
    """A package may stand between modules of the package around it, but not import a sibling that imports it."""
    between = {"a.k.do": {"a.k.gpu.sum"}, "a.k.gpu.sum": {"a.k.sizes"}, "a.k.sizes": set(), "a.k.gpu": set()}
    assert longest_chain(sibling_graph(between, "a.k")) == ["a.k.do", "a.k.gpu", "a.k.sizes"]
    known = {"a", "a.k", "a.k.gpu", "a.k.cpu"}
    assert package_graph(between, known) == {"a.k": set(), "a.k.gpu": set()}
    circle = {**between, "a.k.gpu.sum": {"a.k.cpu.sum"}, "a.k.cpu.sum": {"a.k.gpu.add"}, "a.k.gpu.add": set()}
    for graph in (sibling_graph(circle, "a.k"), package_graph(circle, known)):
        with pytest.raises(CycleError):
            longest_chain(graph)
    assert longest_chain(sibling_graph(circle, "a")) == ["a.k"]


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
        for node in statements(tree_of(path))
        if isinstance(node, ast.FunctionDef) and node.name.startswith("read_") and node.returns
        if "dict[str, Any]" in ast.unparse(node.returns)
    }
    assert untyped == JSON_DOCUMENTS | {"read_arrays"}, "a reader returns a dict; io/typed_record.py makes records"


def test_no_class_name_is_used_twice():
    places = defaultdict(set)
    for module, node in classes():
        places[node.name].add(module)
    assert not {name: sorted(found) for name, found in places.items() if len(found) > 1}


def test_a_main_block_ends_its_module():
    """What stands below it is not defined when it runs."""
    for path in sorted(REPOSITORY.glob("drivesplat/**/*.py")):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        mains = [i for i, node in enumerate(body) if isinstance(node, ast.If) and "__main__" in ast.dump(node.test)]
        assert mains in ([], [len(body) - 1]), path
