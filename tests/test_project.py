"""The project as a whole: pins in one place, planning that stays quick, presets that load."""

import ast
import importlib.metadata
import importlib.util
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from helpers import REPOSITORY
from helpers.syntax_trees import tree_of
from packaging.requirements import Requirement

from drivesplat.settings.config import load, merged

DEVKIT = "nuscenes-devkit"
"""Installed without its requirements, beside those of requirements.txt."""
PYTHONS = ("3.11", "3.12", "3.13")
PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]


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
    """The extra pins the devkit where its numpy has wheels."""
    pinned = constraints(python)
    required = [*requirements("requirements.txt"), *requirements("requirements-dev.txt")]
    assert {requirement.name for requirement in required} == pinned.keys() - {DEVKIT}
    assert [one.name for one in required if pinned[one.name] not in one.specifier] == []
    bounded = {one.name: {part.operator for part in one.specifier} for one in requirements("requirements.txt")}
    assert {name for name, operators in bounded.items() if operators != {">=", "<"}} == set(), "from, and up to"
    (devkit,) = map(Requirement, PROJECT["optional-dependencies"]["nuscenes"])
    assert devkit.name == DEVKIT and pinned[DEVKIT] in devkit.specifier
    assert devkit.marker.evaluate({"python_version": python}) == pinned["numpy"].startswith("1.")


def test_supported_pythons_are_the_same_everywhere():
    named = [name.rpartition(" ")[2] for name in PROJECT["classifiers"] if "Python :: 3." in name]
    assert tuple(named) == PYTHONS and PROJECT["requires-python"] == ">=3.11,<3.14"
    assert f"{'|'.join(PYTHONS)}) ;;" in (REPOSITORY / "scripts/setup.sh").read_text()


def test_everything_that_the_devkits_tables_import_is_required():
    """It is installed without its requirements."""
    folder = Path(importlib.util.find_spec("nuscenes").origin).parents[1]
    waiting, loaded = ["nuscenes.nuscenes"], set()
    while waiting:
        name = waiting.pop()
        files = [folder / f"{name.replace('.', '/')}{end}" for end in (".py", "/__init__.py")]
        for node in (node for file in files if file.is_file() for node in tree_of(file).body):
            names = [it.name for it in node.names] if isinstance(node, ast.Import) else [getattr(node, "module", "")]
            found = {name for name in names if name} - loaded
            waiting += [name for name in found if name.startswith("nuscenes.")]
            loaded |= found
    packages = importlib.metadata.packages_distributions()
    asked = {Requirement(line).name.lower() for line in importlib.metadata.requires(DEVKIT)}
    needed = {package.lower() for name in loaded for package in packages.get(name.partition(".")[0], [])} & asked
    assert {"numpy", "pyquaternion"} <= needed <= {one.name for one in requirements("requirements.txt")}


def test_planning_imports_nothing_heavy():
    """Neither does what it loads to split tables into scenes."""
    code = (
        "import sys, drivesplat.workflow.plan as _, drivesplat.readers.nuscenes.scene_tables as _; "
        "print(' '.join(sys.modules))"
    )
    command = [sys.executable, "-c", code]
    modules = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout
    heavy = {"torch", "gsplat", "nuscenes", "scipy", "pandas", "skimage", "cv2", "matplotlib", "lpips"}
    assert not heavy & set(modules.split())


def test_presets_are_valid_over_the_defaults():
    defaults = yaml.safe_load((REPOSITORY / "config.yaml").read_text())
    presets = [path for pattern in ("*.yaml", "protocols/*.yaml") for path in (REPOSITORY / "presets").glob(pattern)]
    assert len(presets) > 5
    for preset in presets:
        assert load(merged(defaults, yaml.safe_load(preset.read_text()))).scenes, preset.name


def test_scripts_are_thin():
    for script in (REPOSITORY / "workflow_scripts").glob("*.py"):
        assert len([line for line in script.read_text().splitlines() if line.strip()]) <= 25, script.name


def test_each_test_that_make_test_leaves_out_is_run_by_a_target_of_its_own():
    makefile = (REPOSITORY / "Makefile").read_text()
    recipes = dict(re.findall(r"^([\w-]+):.*\n((?:\t.*\n)+)", makefile, re.M))
    left_out = re.findall(r"not (\w+)", recipes["test"])
    markers = PYPROJECT["tool"]["pytest"]["ini_options"]["markers"]
    assert [it.partition(":")[0] for it in markers if "(make test-" in it] == left_out
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
    flags = usage["mandatory-flags"]
    assert flags["flags"].split() == ["--cores", "all"] and usage["software-stack-deployment"]["conda"]
    named = re.findall(r"[\w./]+\.(?:yaml|md)\b", flags["desc"])
    assert len(named) == 2 and all((REPOSITORY / name).is_file() for name in named)


CLOCK = re.compile(r"\b(?:monotonic|perf_counter|process_time|thread_time)(?:_ns)?\(|<.*\btime\.time")
SHORT_WAIT = re.compile(r"(?:\btimeout=|\.(?:wait|join|poll)\()(?:\d|[1-9]\d|[12]\d\d)(?:\.\d*)?\b(?!\d)")


def test_no_test_measures_a_clock_and_none_waits_for_less_than_minutes():
    """A loaded machine fails such tests. Measurements of speed are in benchmarks/; events have `wait_until`."""
    bad = ("time.monotonic()", "seconds < time.time()", "communicate(timeout=60)", "event.wait(5.0)", "x.join(299)")
    good = ("timeout=7200", "timeout=PATIENCE_S", "event.wait(300)", "event.wait()", "began = time.time()")
    for lines, expected in ((bad, True), (good, False)):
        assert all(bool(CLOCK.search(line) or SHORT_WAIT.search(line)) is expected for line in lines)
    found = [
        f"{path.relative_to(REPOSITORY)}:{number}"
        for path in (REPOSITORY / "tests").rglob("*.py")
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if path.name != "test_project.py" and (CLOCK.search(line) or SHORT_WAIT.search(line))
    ]
    assert found == []
