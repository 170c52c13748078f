"""Config files are checked before Snakemake reads them: broken ones are named with the line, targets are not taken for
config files."""

import os
import re
from pathlib import Path

import pytest

from drivesplat.errors import ConfigError
from drivesplat.workflow.config_files import check_config_files, default_config, read_config
from drivesplat.workflow.edits_file import read_edits


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
        ("sky: none\ntrain: &a {iterations: *a}\n", "mine.yaml, line 2: not YAML: found unconstructable recursive"),
        ("a: " + "[" * 20_000 + "]" * 20_000, "mine.yaml: the config file is nested too deeply"),
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
    assert default_config(tmp_path / "elsewhere", tmp_path) == tmp_path / "config.yaml"
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/config.yaml").touch()
    assert default_config(tmp_path / "elsewhere", tmp_path) == tmp_path / "elsewhere/config.yaml"


@pytest.mark.parametrize("place", [0, 1])
def test_a_config_file_that_is_a_pipe_is_refused_before_it_is_read(tmp_path, place):
    """As of `--configfile <(cat mine.yaml)`: Snakemake would wait for ever for what the first reader has taken."""
    files = [str(tmp_path / "a.yaml"), str(tmp_path / "b.yaml")]
    Path(files[1 - place]).write_text("sky: none\n")
    Path(files[place]).unlink(missing_ok=True)
    os.mkfifo(files[place])
    message = rf"{files[place]}: the config file cannot be read \(it is a pipe, not a regular file\)"
    with pytest.raises(ConfigError, match=message):
        check_config_files(files)
    with pytest.raises(ConfigError, match=r"edits file cannot be read \(it is a pipe"):
        read_edits(files[place])


def test_an_endless_or_huge_config_file_is_refused_before_it_is_read(tmp_path):
    (tmp_path / "config.yaml").symlink_to("/dev/zero")
    with pytest.raises(ConfigError, match="it is a device, not a regular file"):
        read_config(default_config(tmp_path))
    (tmp_path / "huge.yaml").touch()
    os.truncate(tmp_path / "huge.yaml", 10**12)
    with pytest.raises(ConfigError, match="it has 1000000 MB, more than 2 MB"):
        read_config(tmp_path / "huge.yaml")


@pytest.mark.parametrize("value", ["2024-13-45", "0x_", "!!timestamp x", "!!bool x", "!!float x", "9" * 5000])
def test_a_value_that_yaml_cannot_read_is_named_with_its_line(tmp_path, value):
    (tmp_path / "mine.yaml").write_text(f"sky: none\nresults_dir: {value}\n")
    message = r"mine\.yaml, line 2: not YAML: .* cannot be read as \w+ \(.*\); quote text$"
    with pytest.raises(ConfigError, match=message):
        read_config(tmp_path / "mine.yaml")
