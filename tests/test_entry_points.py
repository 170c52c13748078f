"""Every `python -m` command prints its help, and none overwrites what a user changed."""

import re
import runpy
import sys

import pytest
from helpers import REPOSITORY

from drivesplat.settings.config_document import config_schema, config_yaml, main, settings_page

IS_COMMAND = re.compile(r'^if __name__ == "__main__":', re.MULTILINE)
COMMANDS = sorted(
    ".".join(path.relative_to(REPOSITORY).with_suffix("").parts).removesuffix(".__main__")
    for folder in ("drivesplat", "benchmarks")
    for path in (REPOSITORY / folder).rglob("*.py")
    if IS_COMMAND.search(path.read_text(encoding="utf-8"))
)


assert {"drivesplat.settings.config_document", "drivesplat.machine.doctor", "benchmarks.speed"} <= set(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
def test_help_is_printed_and_nothing_else_happens(command, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", [command, "--help"])
    monkeypatch.chdir(tmp_path)
    config = (REPOSITORY / "config.yaml").stat().st_mtime_ns
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(command, run_name="__main__", alter_sys=True)
    printed = capsys.readouterr().out
    assert ended.value.code in (0, None) and printed.startswith(f"usage: python -m {command} ")
    assert (REPOSITORY / "config.yaml").stat().st_mtime_ns == config and not list(tmp_path.iterdir())


def test_a_changed_config_is_kept_with_its_difference_shown_unless_forced(tmp_path, capsys):
    changed = config_yaml().replace("results_dir: results", "results_dir: elsewhere")
    (tmp_path / "config.yaml").write_text(changed)
    assert main([], tmp_path) == 1
    printed = capsys.readouterr()
    assert "\n-results_dir: elsewhere\n+results_dir: results\n" in printed.out and "--force" in printed.err
    assert (tmp_path / "config.yaml").read_text() == changed and not (tmp_path / "config.schema.json").exists()
    assert main(["--force"], tmp_path) == 0
    assert (tmp_path / "config.yaml").read_text() == config_yaml()


def test_absent_files_are_written_and_new_settings_come_into_a_config_that_has_no_others(tmp_path):
    whole, config = config_yaml(), tmp_path / "config.yaml"
    assert main([], tmp_path) == 0 and main([], tmp_path) == 0
    assert config.read_text() == whole
    assert (tmp_path / "config.schema.json").read_text() == config_schema()
    assert (tmp_path / "docs/settings.md").read_text() == settings_page()
    lines = whole.splitlines(keepends=True)
    (new,) = (i for i, line in enumerate(lines) if line.startswith("  drive_width:"))
    config.write_text("".join(lines[: new - 1] + lines[new + 1 :]))
    assert main([], tmp_path) == 0 and config.read_text() == whole


@pytest.mark.parametrize("old", ["  drive_width: null\n", "# Compute LPIPS."])
def test_a_config_of_a_user_with_lines_of_its_own_is_kept_though_it_lacks_settings(tmp_path, old):
    lines = config_yaml().splitlines(keepends=True)
    lacking = "".join(line for line in lines if not line.startswith("results_dir:"))
    changed = lacking.replace(old, old[:-1] + "7" + old[-1:])
    assert changed != lacking
    (tmp_path / "config.yaml").write_text(changed)
    assert main([], tmp_path) == 1 and (tmp_path / "config.yaml").read_text() == changed
