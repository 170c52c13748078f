"""A given setting without effect is reported with the override that replaces it."""

import pytest
import yaml
from helpers import REPOSITORY
from helpers.workflow_copy import WorkflowCopy

from drivesplat.settings.config import load, merged
from drivesplat.workflow.costs.run_costs import without_effect

DEFAULTS = yaml.safe_load((REPOSITORY / "config.yaml").read_text())
DEMO, REAL = [("demo", ""), ("demo", "vanilla"), ("demo", "street")], [("0061", "vanilla"), ("0061", "street")]


def sentences(places, **config) -> list[str]:
    return without_effect(load(merged(DEFAULTS, config)), places)


def test_a_setting_that_a_dataset_or_method_overrides_is_reported_once_with_its_place():
    assert sentences([*DEMO, *REAL]) == []
    assert sentences(DEMO, train={"iterations": 3000}) == [
        "train.iterations: 3000 does not hold for dataset demo, where datasets.demo.overrides.train.iterations is 800"
    ]
    assert sentences(REAL, train={"iterations": 3000}) == [], "no scene of the demo takes part"
    (sentence,) = sentences([*DEMO, *REAL], train={"depth_weight": 0.5})
    assert sentence.startswith("train.depth_weight: 0.5 does not hold for method street, where methods.street.")
    assert sentence.endswith("is 0.01")
    assert sentences([("0061", "vanilla")], train={"depth_weight": 0.5}) == []


def test_variants_of_an_ablation_differ_on_purpose():
    config = load(merged(DEFAULTS, {"sky": "none"}))
    variants = [("0061", name) for name in config.ablated]
    assert variants and without_effect(config, variants) == []


@pytest.mark.slow
@pytest.mark.workflow
def test_it_is_reported_once_by_a_dry_run_by_a_run_and_when_nothing_is_to_be_done(tmp_path):
    """The job of the run reads the Snakefile again, in a process of its own, and does not repeat it."""
    data = {"dataroot": "data", "scenes": ["0001"], "overrides": {"train": {"iterations": 7}}}
    copy, expected = WorkflowCopy.make(tmp_path / "workflow", datasets={"nuscenes": data}), "Nothing to be done"
    runs = [copy.run("results/0001/scene.json", flags=flags) for flags in (("-n",), (), (), ("-n",))]
    assert [expected in run.stdout for run in runs] == [False, False, True, True], [run.stdout for run in runs]
    for run in runs:
        (sentence,) = (line for line in run.stdout.splitlines() if "does not hold for" in line)
        assert sentence.startswith("drivesplat: train.iterations: 60 does not hold for dataset nuscenes, where ")
