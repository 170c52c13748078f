"""The project as a whole: pins in one place, planning that stays quick, presets that load."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator

import pytest
import yaml
from helpers import REPOSITORY
from helpers.syntax_trees import tree_of
from packaging.requirements import Requirement

from drivesplat.settings.config import load, merged

DEVKIT = "nuscenes-devkit"
"""Installed without its requirements, beside those of requirements.txt."""
PYTHONS = ("3.11", "3.12", "3.13")


def pins(lines: list[str], python: str) -> dict[str, str]:
    """The pinned versions of a requirements file for a Python, by package."""
    parsed = [Requirement(line) for line in lines if "==" in line and not line.startswith(("#", "--"))]
    chosen = [one for one in parsed if one.marker is None or one.marker.evaluate({"python_version": python})]
    return {one.name: str(one.specifier).removeprefix("==") for one in chosen}


def constraints(python: str) -> dict[str, str]:
    return pins((REPOSITORY / "constraints.txt").read_text().splitlines(), python)


def test_environments_pin_what_the_constraints_pin():
    for path in (REPOSITORY / "envs").glob("*.yaml"):
        dependencies = yaml.safe_load(path.read_text())["dependencies"]
        packages = next(d["pip"] for d in dependencies if isinstance(d, dict))
        python = next(d for d in dependencies if str(d).startswith("python=")).removeprefix("python=")
        environment, pinned = pins(packages, python), constraints(python)
        amds_own = {"torch", "torchvision", "gsplat"} if path.name == "rocm.yaml" else set()
        same = {name: version for name, version in environment.items() if name not in amds_own}
        assert same and all(pinned[name] == version for name, version in same.items()), path.name
        tools = {requirement.name for requirement in requirements("requirements-dev.txt")}
        tools |= {"snakemake-executor-plugin-slurm"}
        assert pinned.keys() - same.keys() == tools | amds_own, path.name


def requirements(name: str) -> list[Requirement]:
    lines = (REPOSITORY / name).read_text().splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize("python", PYTHONS)
def test_every_requirement_is_pinned_within_its_range(python):
    pinned = constraints(python)
    required = [*requirements("requirements.txt"), *requirements("requirements-dev.txt")]
    assert {requirement.name for requirement in required} == pinned.keys() - {DEVKIT}
    assert [one.name for one in required if pinned[one.name] not in one.specifier] == []
    bounded = {one.name: {part.operator for part in one.specifier} for one in requirements("requirements.txt")}
    assert {name for name, operators in bounded.items() if operators != {">=", "<"}} == set(), "from, and up to"


def test_supported_pythons_are_the_same_everywhere():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    named = [name.rpartition(" ")[2] for name in project["classifiers"] if "Python :: 3." in name]
    assert tuple(named) == PYTHONS and project["requires-python"] == ">=3.11,<3.14"
    assert f"{'|'.join(PYTHONS)}) ;;" in (REPOSITORY / "scripts/setup.sh").read_text()


@pytest.mark.parametrize("python", PYTHONS)
def test_the_extra_pins_the_devkit_where_its_numpy_has_wheels(python):
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    (devkit,) = map(Requirement, project["optional-dependencies"]["nuscenes"])
    assert devkit.name == DEVKIT and constraints(python)[DEVKIT] in devkit.specifier
    assert devkit.marker.evaluate({"python_version": python}) == constraints(python)["numpy"].startswith("1.")


def test_everything_that_the_devkits_tables_import_is_required():
    """It is installed without its requirements."""
    code = (
        "import sys; before = {*sys.modules}; from nuscenes.nuscenes import NuScenes; "
        "print(' '.join({it.partition('.')[0] for it in {*sys.modules} - before}))"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    packages = importlib.metadata.packages_distributions()
    asked = {Requirement(line).name.lower() for line in importlib.metadata.requires(DEVKIT)}
    needed = {package.lower() for name in loaded for package in packages.get(name, [])} & asked
    assert needed <= {one.name for one in requirements("requirements.txt")}


def test_planning_imports_nothing_heavy():
    """Neither does what it loads to split tables into scenes."""
    code = (
        "import sys, drivesplat.workflow.plan as _, drivesplat.readers.nuscenes.scene_tables as _; "
        "print(' '.join(sys.modules))"
    )
    modules = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout
    heavy = {"torch", "gsplat", "nuscenes", "scipy", "pandas", "skimage", "cv2", "matplotlib", "lpips"}
    assert not heavy & set(modules.split())


PRESETS = [
    path for pattern in ("*.yaml", "protocols/*.yaml") for path in sorted((REPOSITORY / "presets").glob(pattern))
]


@pytest.mark.parametrize("preset", PRESETS, ids=lambda path: path.stem)
def test_presets_are_valid_over_the_defaults(preset):
    defaults = yaml.safe_load((REPOSITORY / "config.yaml").read_text())
    config = load(merged(defaults, yaml.safe_load(preset.read_text())))
    assert config.scenes


def test_scripts_are_thin():
    for script in (REPOSITORY / "workflow_scripts").glob("*.py"):
        assert len([line for line in script.read_text().splitlines() if line.strip()]) <= 25, script.name


def test_each_test_that_make_test_leaves_out_is_run_by_a_target_of_its_own():
    makefile = (REPOSITORY / "Makefile").read_text()
    recipes = dict(re.findall(r"^([\w-]+):.*\n((?:\t.*\n)+)", makefile, re.M))
    left_out = re.findall(r"not (\w+)", recipes["test"])
    pytest_settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    assert [it.partition(":")[0] for it in pytest_settings["markers"] if "(make test-" in it] == left_out
    for marker in left_out:
        command = next(line for line in recipes[f"test-{marker}"].splitlines() if f"-m {marker}" in line)
        (files,) = re.findall(r"tests/\S+", command) or ["tests"]
        users = (path for path in REPOSITORY.glob("tests/**/*.py") if f"pytest.mark.{marker}" in path.read_text())
        assert all(path.is_relative_to(REPOSITORY / files) for path in users), marker


def test_citation_and_catalog_entry_hold_what_their_readers_require():
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0" and {"message", "title", "authors"} <= citation.keys()
    for reference in citation["references"]:
        assert {"type", "title", "authors", "year"} <= reference.keys() and {"doi", "url"} & reference.keys()
    usage = yaml.safe_load((REPOSITORY / ".snakemake-workflow-catalog.yml").read_text())["usage"]
    assert (
        usage["mandatory-flags"]["flags"].split() == ["--cores", "all"] and usage["software-stack-deployment"]["conda"]
    )
    named = re.findall(r"[\w./]+\.(?:yaml|md)\b", usage["mandatory-flags"]["desc"])
    assert len(named) == 2 and all((REPOSITORY / name).is_file() for name in named)


CLOCKS = {"time", "monotonic", "perf_counter", "process_time", "thread_time"}


def is_clock_value(node: ast.AST, names: set[str]) -> bool:
    """Whether an expression is a clock's time, a name of one, or computed from one."""
    match node:
        case ast.Call(func=ast.Attribute(value=ast.Name("time"), attr=name) | ast.Name(name), args=arguments):
            if name in {"abs", "round", "min", "max", "float", "int"}:
                return any(is_clock_value(argument, names) for argument in arguments)
            return name.removesuffix("_ns") in CLOCKS
        case ast.BinOp(left=one, right=other):
            return is_clock_value(one, names) or is_clock_value(other, names)
        case ast.UnaryOp(operand=one) | ast.NamedExpr(value=one):
            return is_clock_value(one, names)
        case ast.Name(name):
            return name in names
    return False


def assigned(node: ast.AST) -> Iterator[tuple[ast.AST, ast.AST]]:
    """The targets of an assignment with their values."""
    match node:
        case ast.Assign(targets=targets, value=value):
            for target in targets:
                pairs = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
                yield from zip(target.elts, value.elts, strict=False) if pairs else [(target, value)]
        case ast.NamedExpr(target=target, value=value) | ast.AugAssign(target=target, value=value):
            yield target, value


def clock_comparisons(tree: ast.AST) -> set[int]:
    """The lines of a module that compare a clock's time with anything."""
    lines = set()
    for scope in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Module)):
        nodes, names = list(ast.walk(scope)), set()
        for node in nodes if isinstance(scope, ast.FunctionDef) else []:
            names |= {t.id for t, value in assigned(node) if isinstance(t, ast.Name) and is_clock_value(value, names)}
        compared = (node for node in nodes if isinstance(node, ast.Compare))
        lines |= {n.lineno for n in compared if any(is_clock_value(one, names) for one in (n.left, *n.comparators))}
    return lines


def short_waits(tree: ast.AST) -> set[int]:
    """The lines of a module that give an event less than five minutes."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    limits = [(call, word.value) for call in calls for word in call.keywords if word.arg == "timeout"]
    limits += [
        (call, call.args[0])
        for call in calls
        if isinstance(call.func, ast.Attribute) and call.func.attr in ("wait", "join", "poll") and call.args
    ]
    return {
        call.lineno
        for call, limit in limits
        if isinstance(limit, ast.Constant) and isinstance(limit.value, int | float) and limit.value < 300
    }


def test_no_test_measures_a_clock_and_none_waits_for_less_than_minutes():
    """A loaded machine fails such tests. Measurements of speed are in benchmarks/; events have `wait_until`."""
    found = {
        f"{path.relative_to(REPOSITORY)}:{line}"
        for path in (REPOSITORY / "tests").rglob("*.py")
        for line in clock_comparisons(tree_of(path)) | short_waits(tree_of(path))
    }
    assert found == set()


@pytest.mark.parametrize(
    "body",
    [
        "began = time.monotonic()\n    run()\n    assert time.monotonic() - began < 3.0",
        "until, seen = monotonic() + 10, 0\n    while seen < 2 and monotonic() < until: run()",
        "began = time.process_time()\n    seconds = abs(time.process_time() - began)\n    assert 0 < seconds < 5",
        "began = time.time_ns()\n    assert run() < (took := time.time_ns() - began)",
        "process.communicate(timeout=60)",
        "event.wait(5.0)",
    ],
)
def test_uses_of_clocks_are_found_in_every_form(body):
    tree = ast.parse(f"def test():\n    {body}")
    assert clock_comparisons(tree) | short_waits(tree)
