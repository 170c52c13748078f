"""The console script: each command does what its help says, and faults are sentences."""

import os
import subprocess
import sys
import webbrowser
from pathlib import Path

import pytest
import yaml
from helpers import REPOSITORY

from drivesplat import SNAKEFILE, WORKFLOW
from drivesplat.cli import __main__ as command_line
from drivesplat.cli.__main__ import chosen_page, exported_pages, main, results_folder, snakemake_command
from drivesplat.errors import DriveSplatError
from drivesplat.evaluation import summary
from drivesplat.io.this_copy import in_this_copy


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """An empty folder, where the commands run."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def called(monkeypatch) -> list[list[str]]:
    """The command lines of Snakemake that would have run, without interpreter and Snakefile."""
    calls: list[list[str]] = []

    class Process:
        def __init__(self, command, env):
            assert command[1:5] == ["-m", "snakemake", "--snakefile", str(SNAKEFILE)] and env["PYTHONSAFEPATH"]
            calls.append(command[5:])

        def wait(self) -> int:
            return 0 if "fails" not in calls[-1] else 7

    monkeypatch.setattr(command_line.subprocess, "Popen", Process)
    return calls


def test_run_passes_everything_to_snakemake_and_returns_its_status(called):
    assert main(["run", "--cores", "2", "--help", "--version", "--", "results/0103/metrics.json"]) == 0
    assert called == [["--cores", "2", "--help", "--version", "--", "results/0103/metrics.json"]]
    assert main(["run", "fails"]) == 7 and WORKFLOW == REPOSITORY
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0


def test_presets_and_profiles_are_found_from_any_folder_unless_it_has_its_own(folder):
    arguments = ["--configfile=presets/demo.yaml", "--workflow-profile", "profiles/slurm", "presets/8gb.yaml"]
    (folder / "presets").mkdir()
    (folder / "presets/8gb.yaml").touch()
    found = snakemake_command([*arguments, "presets/none.yaml", "--", "all"])[5:]
    demo, slurm = REPOSITORY / "presets/demo.yaml", REPOSITORY / "profiles/slurm"
    kept = ["presets/8gb.yaml", "presets/none.yaml", "--", "all"]
    assert found == [f"--configfile={demo}", "--workflow-profile", str(slurm), *kept]


def test_demo_runs_everything_and_prints_the_figures(called, folder, monkeypatch):
    (folder / "config.yaml").write_text("results_dir: mine\n")
    printed: list[Path] = []
    monkeypatch.setattr(summary, "print_summary", printed.append)
    assert main(["demo", "--cores", "3"]) == 0
    demo = str(REPOSITORY / "presets/demo.yaml")
    assert called == [["--cores", "3", "--configfile", demo, "--", "all"]]
    assert printed == [Path("mine/demo")]
    monkeypatch.setattr(command_line, "run_workflow", lambda _: 3)
    assert main(["demo"]) == 3 and len(printed) == 1, "no figures of a demo that has failed"


def test_config_prints_the_defaults(capsys):
    assert main(["config"]) == 0
    assert yaml.safe_load(capsys.readouterr().out) == yaml.safe_load((REPOSITORY / "config.yaml").read_text())


def ended(command: list[str], **streams) -> tuple[int, str]:
    """The exit status of a command of Python in a process of its own, and what it says to standard error."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    environment |= {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    told = {"cwd": REPOSITORY, "env": environment, "stderr": subprocess.PIPE, "text": True, "check": False}
    done = subprocess.run([sys.executable, *command], **told, **streams)
    return done.returncode, done.stderr


CONFIG = ["-c", "import sys; from drivesplat.cli.__main__ import main; sys.exit(main(['config']))"]
SCHEMA = ["-m", "drivesplat.readers.drive", "schema"]


@pytest.mark.parametrize("command", [CONFIG, SCHEMA])
def test_a_full_disk_behind_standard_output_is_named_and_a_closed_pipe_ends_quietly(command):
    with open("/dev/full", "w") as full:
        status, said = ended(command, stdout=full)
    assert (status, said.count("\n")) == (1, 1)
    assert said.startswith("drivesplat: standard output: cannot be written (No space left on device)")
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as pipe:
        assert ended(command, stdout=pipe) == (0, "")


def test_config_escapes_what_the_encoding_lacks(folder):
    with open("mine.yaml", "wb") as file:
        assert ended(CONFIG, stdout=file) == (0, "")
    text = Path("mine.yaml").read_text(encoding="ascii")
    assert "\\u2265" in text, "the sign of 'at least'"
    assert yaml.safe_load(text) == yaml.safe_load((REPOSITORY / "config.yaml").read_text())


def test_a_command_in_a_removed_folder_says_so(folder, monkeypatch, capsys):
    (folder / "gone").mkdir()
    monkeypatch.chdir(folder / "gone")
    (folder / "gone").rmdir()
    for command in ("open", "run", "demo"):
        assert main([command]) == 1
        said = capsys.readouterr().err
        assert said == "drivesplat: the current folder has been removed; change to another one\n"


def page(folder: Path, scene: str, method: str, seconds: int, moving: bool = False) -> None:
    """A page that was exported at a time, beside the film of moving objects if there are any."""
    made = folder / "results" / scene / method / "viewer.html"
    made.parent.mkdir(parents=True, exist_ok=True)
    made.touch()
    os.utime(made, (seconds, seconds))
    if moving:
        made.with_name("parts.mp4").touch()


@pytest.mark.parametrize(
    ("scene", "method", "expected"),
    [(None, None, "0103/street"), ("0061", None, "0061/street"), (None, "vanilla", "0103/vanilla")],
)
def test_open_takes_the_scene_exported_last_and_a_method_with_moving_objects(folder, scene, method, expected):
    page(folder, "0061", "vanilla", 1)
    page(folder, "0061", "street", 2, moving=True)
    page(folder, "0103", "street", 3, moving=True)
    page(folder, "0103", "vanilla", 4)
    chosen = chosen_page(exported_pages(Path("results")), Path("results"), scene, method)
    assert chosen == Path(f"results/{expected}/viewer.html")


def test_open_opens_the_page_and_names_the_others(folder, monkeypatch, capsys):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open_new_tab", lambda address: not opened.append(address))
    page(folder, "0061", "vanilla", 1)
    page(folder, "0061", "street", 2)
    assert main(["open"]) == 0
    assert opened == [(folder / "results/0061/street/viewer.html").as_uri()]
    assert capsys.readouterr().out == "opened results/0061/street/viewer.html; there are also: 0061 vanilla\n"


def test_open_without_a_page_or_a_browser_says_what_to_do(folder, monkeypatch, capsys):
    assert main(["open", "0103"]) == 1
    line = capsys.readouterr().err
    wanted = "results/0103/{method}/viewer.html"
    assert line.startswith(f"drivesplat: there is no {wanted}; exported are: none.") and "drivesplat run" in line
    page(folder, "0061", "vanilla", 1)
    monkeypatch.setattr(webbrowser, "open_new_tab", lambda _: False)
    assert main(["open"]) == 1
    assert capsys.readouterr().err.startswith("drivesplat: no browser was found; open /")


def test_results_are_where_the_config_of_the_folder_puts_them(folder):
    assert results_folder() == Path("results")
    (folder / "config.yaml").write_text("results_dir: results/first\n")
    assert results_folder() == Path("results/first")
    (folder / "config.yaml").write_text("results_dir: [\n")
    with pytest.raises(DriveSplatError, match=r"config\.yaml"):
        results_folder()


def test_an_installed_copy_names_commands_that_it_has():
    assert in_this_copy("run `make setup`", is_checkout=True) == "run `make setup`"
    installed = {
        "run `make setup`, `make doctor` says more": "run `drivesplat setup`, `drivesplat doctor` says more",
        'GSPLAT_ARCHS="8.6" make setup': 'GSPLAT_ARCHS="8.6" drivesplat setup',
        "`snakemake --cores 1 all` makes it": "`drivesplat run --cores 1 all` makes it",
        "rm -r .venv, then make setup": "a new installation by pip",
        "`rm -r .venv; make setup` reinstalls it": "a new installation by pip reinstalls it",
        "what they make; make test": "what they make; make test",
    }
    assert {text: in_this_copy(text, is_checkout=False) for text in installed} == installed
    build = in_this_copy("install the build: TORCH_CUDA=cu126 make setup", is_checkout=False)
    assert "pip install" in build and build.endswith("whl/cu126") and "make" not in build
