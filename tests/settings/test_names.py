"""Names of scenes, methods and datasets, and the folder of results: what no folder can be called is refused at once."""

from pathlib import Path

import pytest

from drivesplat.errors import ConfigError
from drivesplat.settings.config import Config, load
from drivesplat.workflow.edits_file import read_edits


def refusal(**values) -> str:
    with pytest.raises(ConfigError) as failure:
        load(values)
    assert "\n" not in str(failure.value) and len(str(failure.value)) < 300
    return str(failure.value)


BAD_NAMES = {
    **dict.fromkeys(("a\n", "a/b", "</script>", ""), "cannot name a folder: use letters"),
    **dict.fromkeys(
        ("masks", "discovered", "unlabelled", "metrics.json", "scene.json", "gap_report.html"),
        "results of the workflow are called so",
    ),
    "a" * 300: "has 300 characters; use at most 100",
}


@pytest.mark.parametrize("name", BAD_NAMES, ids=lambda name: repr(name[:20]))
def test_a_name_that_cannot_be_a_folder_or_is_that_of_a_result_is_refused(name):
    assert f"method {name[:20]!r}"[:-1] in refusal(methods={name: {}})
    for message, kind in (
        (refusal(methods={name: {}}), "method"),
        (refusal(datasets={"mine": {"scenes": [name]}}), "scene"),
        (refusal(datasets={name: {"scenes": ["1"]}}), "dataset"),
    ):
        assert message.startswith(kind) and BAD_NAMES[name] in message


@pytest.mark.parametrize("name", ["v1.5", "a-b_c", "0061", "json", "m" * 100])
def test_other_names_are_allowed(name):
    assert load({"methods": {name: {}}, "datasets": {name: {"scenes": [name]}}}).scenes == [name]


def test_an_edit_with_too_long_a_name_is_refused(tmp_path):
    (tmp_path / "edits.yaml").write_text(f"edits: {{{'e' * 300}: [{{remove: {{track: x}}}}]}}\n")
    with pytest.raises(ConfigError, match="has 300 characters; use at most 100"):
        read_edits(tmp_path / "edits.yaml")


@pytest.mark.parametrize(
    ("given", "folder"),
    [
        ("./results/", "results"), ("results//", "results"), ("a/../b", "b"), ("../shared", "../shared"),
        ("/data/x/", "/data/x"), ("with space", "with space"),
    ],
)  # fmt: skip
def test_a_results_folder_is_written_in_one_way(given, folder):
    assert load({"results_dir": given}).results_dir == folder


def test_a_results_folder_in_the_home_folder_is_expanded(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load({"results_dir": "~/x"}).results_dir == str(tmp_path / "x")
    assert Path(Config().results_dir) == Path("results")


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ("res{x}", "cannot hold"), ("res*", "cannot hold"), ("a\nb", "cannot hold"), ("<x>", "cannot hold"),
        ("s3://bucket/x", "results are files of this machine"), ("~nobody-at-all/x", "no such home folder"),
        (".", "a folder of their own"), ("a/..", "a folder of their own"), ("/", "a folder of their own"),
    ],
)  # fmt: skip
def test_a_results_folder_that_snakemake_could_not_use_is_refused(given, why):
    message = refusal(results_dir=given)
    assert message.startswith(f"'results_dir' is {given!r}: ") and why in message


@pytest.mark.parametrize(
    ("scene", "meant"), [("103", "0103"), ("00103", "0103"), ("0130", "0103"), ("dem", "demo"), ("xyz", None)]
)
def test_a_misspelled_scene_is_answered_with_the_one_that_was_meant(scene, meant):
    suggestion = f"did you mean {meant}\\? " if meant else ""
    with pytest.raises(ConfigError, match=f"scene '{scene}' is not in the config; {suggestion}there are: "):
        Config().dataset_of(scene)


def test_a_misspelled_camera_is_named_before_the_evaluated_one():
    message = refusal(cameras=["CAM_FRONTT"])
    assert "(CAM_FRONTT): did you mean CAM_FRONT? nuScenes has CAM_FRONT, CAM_FRONT_RIGHT" in message
    own = refusal(cameras=["left"], eval_camera="right")
    assert own == "eval_camera right is not among cameras (left)"
