"""Config files are checked before Snakemake reads them: broken ones are named with the line, targets are not taken for
config files."""

import re
from pathlib import Path

import pytest

from drivesplat.errors import ConfigError
from drivesplat.workflow.config_files import check_config_files, default_config, read_config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "mine.yaml: the config file is empty"),
        ("# sky: none\n", "mine.yaml: the config file is empty"),
        ("sky: none\ntrain: {iterations: [1\nsweeps: 3\n", "mine.yaml, line 3: not YAML: expected ',' or ']'"),
        ("sky: none\n\ttrain: 3\n", "mine.yaml, line 2: not YAML: found character '\\t'"),
        ("train: {iterations: 3}\nsky: none\ntrain: {cap_max: 9}\n", "mine.yaml, line 3: .*'train' stands twice"),
        ("train:\n  iterations: 3\n  iterations: 4\n", "mine.yaml, line 3: .*'iterations' stands twice"),
        ("- sky\n", "mine.yaml, line 1: ['sky'] is no setting"),
        ("sky\n", "mine.yaml, line 1: 'sky' is no setting"),
    ],
)
def test_a_broken_config_file_is_named_with_its_line(tmp_path, text, message):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as refusal:
        read_config(path)
    expected = message.replace("[", "\\[").replace("]", "\\]").replace("\\t", "\\\\t")
    assert re.search(expected, str(refusal.value)), refusal.value


def test_a_config_file_that_is_absent_or_binary_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: the config file cannot be read"):
        check_config_files([str(tmp_path / "nowhere.yaml")])
    (tmp_path / "mine.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"mine\.yaml: the config file is not UTF-8"):
        check_config_files([str(tmp_path / "mine.yaml")])


@pytest.mark.parametrize("targets", [["all"], ["results/0103/metrics.json"], ["results/0103/vanilla/ghost.png", "all"]])
def test_targets_after_configfile_are_refused_with_the_missing_dashes(tmp_path, monkeypatch, targets):
    """Also where the target is a file that exists."""
    monkeypatch.chdir(tmp_path)
    for name in ("mine.yaml", "more.yml", "results/0103/vanilla/ghost.png"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text("sky: none\n")
    check_config_files(["mine.yaml", "more.yml"])
    with pytest.raises(ConfigError) as refusal:
        check_config_files(["mine.yaml", "more.yml", *targets])
    assert f"--configfile mine.yaml more.yml -- {' '.join(targets)}" in str(refusal.value)


def test_the_working_directory_has_its_own_config_or_takes_the_workflows(tmp_path):
    workflow, elsewhere = tmp_path / "workflow", tmp_path / "elsewhere"
    workflow.mkdir()
    elsewhere.mkdir()
    assert default_config(elsewhere, workflow) == workflow / "config.yaml"
    (elsewhere / "config.yaml").touch()
    assert default_config(elsewhere, workflow) == elsewhere / "config.yaml"
