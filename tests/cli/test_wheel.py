"""The wheel: it brings the whole workflow along, and an installed copy plans and computes as a checkout does."""

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from helpers import REPOSITORY
from helpers.patience import PATIENCE_S
from packaging.requirements import Requirement

from drivesplat.provenance.code.code_digest import code_digest

FOLDERS = ("envs", "presets", "profiles", "report", "rules", "workflow_scripts")
FILES = (
    "Snakefile", "config.yaml", "config.schema.json", "docs/ghosts.md", "docs/images/ghosts.webp", "docs/settings.md",
)  # fmt: skip
PLACE = "drivesplat/_workflow"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built by the backend of pyproject.toml, as pip does it, without network."""
    from hatchling.build import build_wheel

    folder, before = tmp_path_factory.mktemp("wheel"), Path.cwd()
    os.chdir(REPOSITORY)
    try:
        return folder / build_wheel(str(folder))
    finally:
        os.chdir(before)


@pytest.fixture(scope="module")
def site(wheel, tmp_path_factory) -> Path:
    """A folder into which it was unpacked, as into site-packages."""
    folder = tmp_path_factory.mktemp("site")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


def python(site: Path, code: str, *arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    """Runs code with the installed copy, and no checkout, to import from."""
    environment = {**os.environ, "PYTHONPATH": str(site), "CUDA_VISIBLE_DEVICES": "", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)


def source_files(folder: Path) -> set[str]:
    """All files of a folder of the checkout but caches, by path from the checkout."""
    files = (file for file in folder.rglob("*") if file.is_file() and "__pycache__" not in file.parts)
    return {file.relative_to(REPOSITORY).as_posix() for file in files}


def test_it_holds_the_library_and_the_whole_workflow(wheel):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    workflow = {*FILES, *(file for folder in FOLDERS for file in source_files(REPOSITORY / folder))}
    assert names == source_files(REPOSITORY / "drivesplat") | {f"{PLACE}/{file}" for file in workflow}


def test_its_dependencies_are_those_of_the_requirements(wheel):
    archive = zipfile.ZipFile(wheel)
    (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    record = message_from_bytes(archive.read(metadata))
    lines = (REPOSITORY / "requirements.txt").read_text().splitlines()
    required = {line.partition(">")[0] for line in lines if line and line[0] != "#"}
    found = map(Requirement, record.get_all("Requires-Dist"))
    assert {one.name for one in found if not one.marker} == required
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    assert record["Version"] == project["version"] and record["Requires-Python"] == "<3.14,>=3.11"


@pytest.mark.slow
def test_an_installed_copy_has_the_code_digests_of_the_checkout_and_its_own_pages(site, tmp_path):
    """A result is not out of date where another installation made it."""
    code = (
        "import json; from drivesplat import IS_CHECKOUT, WORKFLOW; from drivesplat.export import viewer_page; "
        "from drivesplat.provenance.code.code_digest import code_digest; "
        "from drivesplat.report.files import render_ghosts_page; "
        "assert not IS_CHECKOUT and '<h2' in render_ghosts_page(); "
        "print(json.dumps({p.stem: code_digest(p) for p in (WORKFLOW / 'workflow_scripts').glob('*.py')}))"
    )
    done = python(site, code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    scripts = (REPOSITORY / "workflow_scripts").glob("*.py")
    assert json.loads(done.stdout) == {script.stem: code_digest(script) for script in scripts}


@pytest.mark.slow
def test_an_installed_copy_plans_the_demo_in_an_empty_folder(site, tmp_path):
    """With the packaged Snakefile, presets, edits and default profile; it writes nothing where it is installed."""
    before = {file for file in site.rglob("*") if "__pycache__" not in file.parts}
    code = "import sys; from drivesplat.cli.__main__ import main; sys.exit(main())"
    planned = python(site, code, "run", "-n", "--configfile", "presets/demo.yaml", "--", "all", cwd=tmp_path)
    assert planned.returncode == 0, planned.stderr
    output = planned.stdout + planned.stderr
    assert "rule demo_world_demo:" in output and "results/demo/street/edits/stop.mp4" in output, output
    assert f"{PLACE}/profiles/default" in output, "the default profile holds"
    assert {file for file in site.rglob("*") if "__pycache__" not in file.parts} == before
    assert not (tmp_path / "drivesplat").exists()


def test_the_image_copies_files_that_exist_and_ignores_none_that_the_wheel_needs():
    lines = (REPOSITORY / "Containerfile").read_text().splitlines()
    copied = [
        part for line in lines if line.startswith("COPY ") and "--from" not in line for part in line.split()[1:-1]
    ]
    assert {"constraints.txt", "scripts"} < set(copied) and all((REPOSITORY / part).exists() for part in copied)
    ignored = {line.strip("/") for line in (REPOSITORY / ".containerignore").read_text().splitlines()}
    needed = {*FOLDERS, *FILES, "drivesplat", "docs", "README.md", "pyproject.toml", "requirements.txt"}
    assert not ignored & needed and "results" in ignored, "results of a checkout stay out of an image"
