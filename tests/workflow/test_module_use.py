"""The workflow as a module of another one: an outer Snakefile that imports it, with and without a prefix."""

import json
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from helpers import REPOSITORY
from helpers.forked_snakemake import run_snakemake
from helpers.shared_runs import VANILLA
from helpers.workflow_copy import WorkflowCopy
from snakemake.path_modifier import PathModifier

from drivesplat.errors import ConfigError, DatasetError
from drivesplat.workflow.module_use import module_config, stop_at_absent_data, take_prefix
from drivesplat.workflow.plan import Plan

DEFAULTS = REPOSITORY / "config.yaml"
MODULE = """
module {name}:
    snakefile: "{snakefile}"
    config: {config}
{prefix}
use rule * from {name} as {name}_*
"""
OUTER = """
configfile: "outer.yaml"
{modules}
rule summary:
    input:
        rules.first_scene_metrics.output.metrics.format(scene="0001"),
        "made/second/mine/0001/metrics.json",
    output: "summary.json",
    run:
        import json
        found = [json.load(open(path))["methods"]["vanilla"]["gaussians"] for path in input]
        json.dump(found, open(output[0], "w"))

rule everything:
    default_target: True
    input: rules.summary.output
"""


def prefix_of(*prefixes: str | None) -> tuple[str, str]:
    """The prefix taken from a module, or from a module of a module, and what Snakemake makes of a path afterwards."""
    modifier = None
    for prefix in prefixes:
        modifier = PathModifier(None, prefix, None, modifier)
    workflow = SimpleNamespace(modifier=SimpleNamespace(path_modifier=modifier))
    return take_prefix(workflow), str(workflow.modifier.path_modifier.replace_prefix("results/x"))


def test_the_prefix_is_the_workflows_own_affair_and_snakemake_adds_none():
    assert prefix_of(None) == ("", "results/x")
    assert prefix_of("made") == ("made", "results/x")
    assert prefix_of("outer/", "made") == ("outer/made", "results/x")


def test_a_modules_config_is_laid_over_the_defaults_and_stays_as_it_is():
    given = {"datasets": {"demo": {"batch": True}}, "results_dir": "mine"}
    before = json.dumps(given)
    config = module_config(given, DEFAULTS, "made")
    defaults = yaml.safe_load(DEFAULTS.read_text())
    assert config["results_dir"] == "made/mine" and config["datasets"]["demo"]["dataroot"] == "made/resources/demo"
    assert config["datasets"]["demo"]["batch"] and config["datasets"]["nuscenes"] == defaults["datasets"]["nuscenes"]
    assert config["train"] == defaults["train"] and json.dumps(given) == before
    assert module_config({"results_dir": "/data/x"}, DEFAULTS, "made")["results_dir"] == "/data/x"
    assert module_config({}, DEFAULTS, "") == defaults


@pytest.mark.parametrize("given", [[1], "mine.yaml", 3, None])
def test_a_config_of_a_module_that_is_no_mapping_is_refused(given):
    with pytest.raises(ConfigError) as refused:
        module_config(given, DEFAULTS, "made")
    assert str(refused.value) == f"the config of the module statement is {given!r}; it must be a mapping of settings"


def test_absent_data_ends_the_process_with_one_line():
    def absent(_: Any) -> str:
        raise DatasetError("there is no folder nowhere")

    plan = Plan({}, str(REPOSITORY))
    plan.tables, plan.scene_tables, plan.root = lambda at: [f"{at}.json"], absent, absent
    stop_at_absent_data(plan)
    assert plan.tables("0001") == ["0001.json"]
    for look in (plan.scene_tables, plan.root):
        with pytest.raises(SystemExit, match=r"^drivesplat: there is no folder nowhere$"):
            look("0001")


class Outer:
    """An outer workflow at `folder`, which imports the `copy` of the workflow twice."""

    def __init__(self, folder: Path, copy: WorkflowCopy):
        self.folder, self.copy = folder, copy
        dataset = {"nuscenes": {"dataroot": os.path.relpath(copy.folder / "data", folder), "scenes": ["0001"]}}
        splats = {**copy.config, "datasets": dataset}
        (folder / "outer.yaml").write_text(yaml.safe_dump({"splats": splats, "of_the_outer_workflow": 3}))
        snakefile = copy.folder / "Snakefile"
        second = 'config["splats"] | {"results_dir": "mine"}'
        modules = MODULE.format(name="first", snakefile=snakefile, config='config["splats"]', prefix="")
        modules += MODULE.format(name="second", snakefile=snakefile, config=second, prefix='    prefix: "made/second"')
        (folder / "modules").write_text(modules)
        (folder / "Snakefile").write_text(OUTER.format(modules=modules))

    def run(self, *arguments: str) -> subprocess.CompletedProcess:
        environment = {**os.environ, "PYTHONPATH": "", "CUDA_VISIBLE_DEVICES": ""}
        return run_snakemake(["--cores", "2", *arguments], self.folder, environment, 300)


@pytest.fixture(scope="module")
def outer(tmp_path_factory) -> Outer:
    folder = tmp_path_factory.mktemp("outer")
    return Outer(folder, WorkflowCopy.make(tmp_path_factory.mktemp("imported") / "workflow", methods=VANILLA))


@pytest.mark.slow
@pytest.mark.workflow
def test_an_outer_workflow_plans_both_modules_and_its_own_rules(outer):
    """Also with targets, a folder and options that are the outer workflow's alone."""
    done = outer.run("-n", "--", "summary")
    assert done.returncode == 0, done.stdout
    for module, results in (("first", "results"), ("second", "made/second/mine")):
        assert f"rule {module}_train:" in done.stdout
        assert f"output: {results}/0001/vanilla/checkpoint.npz" in done.stdout
    assert "made/second/made/second" not in done.stdout and "rule summary:" in done.stdout
    refused = outer.run("-n", "first_estimate")
    assert refused.returncode != 0 and "first_estimate" in refused.stdout, "a module has no estimate"
    moved = OUTER.format(modules=(outer.folder / "modules").read_text()).replace("prefix:", 'pathvars: results="x"\n#')
    (outer.folder / "moved.smk").write_text(moved)
    assert "drivesplat: pathvars of another workflow move results" in outer.run("-n", "-s", "moved.smk").stdout


@pytest.mark.slow
@pytest.mark.workflow
def test_an_outer_workflow_runs_the_tiny_world_and_the_results_are_those_of_the_workflow_itself(outer):
    done = outer.run()
    assert done.returncode == 0, done.stdout
    first, second = outer.folder / "results", outer.folder / "made/second/mine"
    found = [json.loads((folder / "0001/metrics.json").read_text()) for folder in (first, second)]
    summary = json.loads((outer.folder / "summary.json").read_text())
    assert summary == [one["methods"]["vanilla"]["gaussians"] for one in found] and all(summary)
    assert {"extract", "vanilla/train", "vanilla/evaluate"} <= found[0]["provenance"]["stages"].keys()
    assert found[0]["provenance"]["code_sha256"] == found[1]["provenance"]["code_sha256"]
    again = outer.run("-n", "--rerun-triggers", "mtime", "params", "input", "software-env")
    assert "Nothing to be done" in again.stdout, again.stdout
    alone = ["-s", str(outer.copy.folder / "Snakefile"), "--configfile", "mine.yaml", "-n", "--cores", "1"]
    settings = yaml.safe_load((outer.folder / "outer.yaml").read_text())["splats"]
    (outer.folder / "mine.yaml").write_text(yaml.safe_dump(settings))
    same = run_snakemake([*alone, "--", "results/0001/metrics.json"], outer.folder, dict(os.environ), 300)
    assert "Nothing to be done" in same.stdout, same.stdout
