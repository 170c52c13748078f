"""Code that is edited while a run is under way: its jobs stop, and no result of other code counts as up to date."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import REPOSITORY
from helpers.workflow_copy import WorkflowCopy, complaints

from drivesplat.errors import ConfigError
from drivesplat.provenance.code.code_digest import code_digest
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.running_code import PLANNED, planned_digest

SEED = "results/0001/seed.ply"
EDITED = "drivesplat/preprocess/lidar_seed.py"
CHANGED = "code of {} changed since the run was planned; start again"
EDIT = f"""
from pathlib import Path
edited = Path({EDITED!r})
source = edited.read_text()
assert source.count("new.append((points,") == 1
edited.write_text(source.replace("new.append((points,", "new.append((points + 5.0,"))
"""


@pytest.mark.workflow
@pytest.mark.xdist_group("workflow")
def test_a_job_whose_code_was_edited_after_planning_stops_and_leaves_nothing(tmp_path):
    copy = WorkflowCopy.make(tmp_path / "copy")
    extract, sound = copy.folder / "workflow_scripts/extract.py", (copy.folder / EDITED).read_text()
    extract.write_text(extract.read_text() + EDIT)
    done = copy.run(SEED)
    assert done.returncode == 1
    assert complaints(done.stdout) == {f"drivesplat: lidar_seed 0001: {CHANGED.format('lidar_seed')}"}
    assert not (copy.folder / SEED).exists()
    assert (copy.folder / "results/0001/scene.json").exists(), "the code of 'extract' was the planned one"
    (copy.folder / EDITED).write_text(sound)
    assert copy.planned(SEED) == {"lidar_seed": 1}


SCRIPT = """
from types import SimpleNamespace
from pathlib import Path
{before}
snakemake = SimpleNamespace(input=[], output=[], wildcards=[], log=["it.log"], threads=1, rule="toy", resources=dict())
snakemake.params = SimpleNamespace(code={code!r})
__real_file__ = __file__; __file__ = {script!r}
{source}"""
TOY = """
from drivesplat.workflow.job import job
{imported}
with job(snakemake) as current:
    {body}
"""
LATE = "drivesplat/io/point_cloud.py"
AND_BACK = (
    f"late = Path({LATE!r}); source = late.read_text(); late.write_text(source + 'X = 1\\n'); "
    "{}late.write_text(source)"
)
"""An edit of a module, what happens meanwhile, and its undoing."""


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> Path:
    """A folder with a copy of the library."""
    folder = tmp_path_factory.mktemp("library")
    shutil.copytree(REPOSITORY / "drivesplat", folder / "drivesplat")
    return folder


def outcome(folder: Path, imported: str, body: str, before: str = "", running: str | None = None) -> str:
    """What a rule's script logs as an error, or an empty text: run as Snakemake does, from a copy behind a preamble,
    planned with its present code. It imports `point_cloud` as `imported` says, has a body, and a `before` that is
    executed when it starts; `running` stands in for the source that runs."""
    script, source = folder / "toy.py", TOY.format(imported=imported, body=body)
    script.write_text(source)
    ask = "import sys; from drivesplat.provenance.code.code_digest import code_digest; print(code_digest(sys.argv[1]))"
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    told = {"cwd": folder, "env": environment, "capture_output": True, "text": True}
    code = subprocess.run([sys.executable, "-c", ask, str(script)], check=True, **told).stdout.strip()
    filled = SCRIPT.format(before=before, code=code, script=str(script), source=running or source)
    (folder / "tmp.toy.py").write_text(filled)
    done = subprocess.run([sys.executable, "tmp.toy.py"], check=False, **told)
    assert done.returncode in (0, 1) and "Traceback" not in done.stderr, done.stderr
    return done.stderr.strip()


STOPS = f"drivesplat: toy: {CHANGED.format('toy')}"
IMPORT = "from drivesplat.io import point_cloud"


@pytest.mark.parametrize(
    ("imported", "body"),
    [(IMPORT, AND_BACK.format("")), ("", "import drivesplat.io.point_cloud")],
    ids=["changed after its import", "imported late"],
)
def test_a_job_ends_that_runs_the_planned_code(library, imported, body):
    assert outcome(library, imported, body) == ""


@pytest.mark.parametrize(
    ("imported", "body", "running"),
    [
        (AND_BACK.format("from drivesplat.io import point_cloud; ").replace("; ", "\n"), "pass", None),
        ("", AND_BACK.format("import drivesplat.io.point_cloud; "), None),
        ("", "Path('drivesplat/report/page/page.js').touch(); import drivesplat.report.page", None),
        ("", "pass", TOY.format(imported="X = 1", body="pass")),
    ],
    ids=["while it starts", "while it runs", "a page while it runs", "the script when Snakemake copied it"],
)
def test_an_edit_that_is_undone_stops_a_job_that_has_imported_it(library, imported, body, running):
    assert outcome(library, imported, body, running=running) == STOPS


def test_bytecode_of_the_same_size_and_second_is_not_run_instead_of_an_edit(library, tmp_path):
    """Python recognizes its bytecode by size and second of its source alone."""
    module, script = library / "drivesplat/toy.py", tmp_path / "script.py"
    script.write_text("from drivesplat import toy\n")
    ask = [sys.executable, "-c", "from drivesplat import toy; print(toy.VALUE)"]
    digest = f"from drivesplat.provenance.code.code_digest import code_digest as d; d({str(script)!r})"
    digest = [sys.executable, "-c", digest]
    told = {"cwd": library, "env": {"PYTHONPATH": str(library)}, "check": True}
    for value in ("1", "2"):
        module.write_text(f"VALUE = {value}\n")
        os.utime(module, (1e9, 1e9))
        subprocess.run(digest, **told)
        assert subprocess.run(ask, stdout=subprocess.PIPE, text=True, **told).stdout == f"{value}\n"


def test_jobs_of_a_cluster_get_the_digests_of_the_plan(monkeypatch):
    """They plan again on their machine, where the code may be another by then."""
    monkeypatch.setenv(PLANNED, "{}")
    config = {"datasets": {"a": {"scenes": ["a1"]}}}
    script = REPOSITORY / "workflow_scripts/extract.py"
    assert Plan(config, str(REPOSITORY)).code("extract") == code_digest(script)
    handed = json.loads(os.environ[PLANNED])
    monkeypatch.setenv(PLANNED, json.dumps({**handed, str(script): "planned"}))
    assert Plan(config, str(REPOSITORY), is_main=False).code("extract") == "planned"
    with pytest.raises(ConfigError, match="the settings changed since the run was planned; start again"):
        Plan({**config, "random_seed": 5}, str(REPOSITORY), is_main=False)
    assert Plan({**config, "random_seed": 5}, str(REPOSITORY)).code("extract") == code_digest(script)
    assert planned_digest("other", lambda: "computed", is_main=False) == "computed"
