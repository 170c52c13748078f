"""The project as a whole: pins in one place, planning that stays quick, presets that load."""

import re
import subprocess
import sys
import tomllib

import pytest
import yaml
from helpers import REPOSITORY
from packaging.requirements import Requirement

from drivesplat.settings.config import load, merged


def pins(lines: list[str]) -> dict[str, str]:
    return dict(line.strip().split("==") for line in lines if "==" in line and not line.strip().startswith("#"))


def test_environments_pin_what_the_constraints_pin():
    constraints = pins((REPOSITORY / "constraints.txt").read_text().splitlines())
    for path in (REPOSITORY / "envs").glob("*.yaml"):
        packages = next(d["pip"] for d in yaml.safe_load(path.read_text())["dependencies"] if isinstance(d, dict))
        environment = pins(packages)
        amds_own = {"torch", "torchvision", "gsplat"} if path.name == "rocm.yaml" else set()
        same = {name: version for name, version in environment.items() if name not in amds_own}
        assert same and all(constraints[name] == version for name, version in same.items()), path.name
        tools = {requirement.name for requirement in requirements("requirements-dev.txt")}
        tools |= {"snakemake-executor-plugin-slurm"}
        assert constraints.keys() - same.keys() == tools | amds_own, path.name


def requirements(name: str) -> list[Requirement]:
    lines = (REPOSITORY / name).read_text().splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith("#")]


def test_every_requirement_is_pinned_within_its_range():
    pinned = pins((REPOSITORY / "constraints.txt").read_text().splitlines())
    required = [*requirements("requirements.txt"), *requirements("requirements-dev.txt")]
    assert [requirement.name for requirement in required] == list(pinned)
    assert [one.name for one in required if pinned[one.name] not in one.specifier] == []
    bounded = {one.name: {part.operator for part in one.specifier} for one in requirements("requirements.txt")}
    assert {name for name, operators in bounded.items() if operators != {">=", "<"}} == set(), "from, and up to"


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
