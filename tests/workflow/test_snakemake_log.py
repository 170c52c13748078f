"""Snakemake's reasons for jobs: changed settings by name, and the text that they are taken from."""

import json
import logging

import pytest
from snakemake.jobs import Reason
from snakemake.persistence import ParamsChange

from drivesplat.workflow.snakemake_log import MAX_CHANGES, name_changes

TRAIN = {"parts": ["background"], "train": {"ssim_weight": 0.2, "note": "it's \"so\", now: 'x'", "sky": None}}
OTHER = {**TRAIN, "train": {**TRAIN["train"], "ssim_weight": 0.3}}
CODE, NEW_CODE = "ab" * 32, "cd" * 32


def shortened(old: list[str], new: list[str], method: str | None = "street", **also: bool) -> str:
    """The reason that is logged for a job of `train` whose params were and are these, where `also` is changed."""
    reason = Reason()
    for name, value in also.items():
        setattr(reason, name, value)
    only_old, only_new = ({repr(value) for value in values} for values in (old, new))
    reason.params_changed = ParamsChange(only_old - only_new, only_new - only_old, {"checkpoint.npz"})
    record = logging.makeLogRecord({"reason": str(reason), "rule_name": "train"})
    record.wildcards = {"scene": "0001", **({"method": method} if method else {})}
    assert name_changes(record)
    return record.reason


def dumped(record: dict) -> str:
    return json.dumps(record, sort_keys=True, separators=(",", ":"))


def test_a_changed_setting_is_named_with_its_old_and_new_value():
    assert shortened([dumped(TRAIN), CODE], [dumped(OTHER), CODE]) == "train street: train.ssim_weight 0.2 -> 0.3"


def test_changed_code_is_named_by_its_rule():
    assert shortened([CODE], [NEW_CODE], method=None) == "train: code of train changed"
    changed = shortened([dumped(TRAIN), CODE], [dumped(OTHER), NEW_CODE], input_changed=True)
    assert changed == (
        "Set of input files has changed since last execution; "
        "train street: train.ssim_weight 0.2 -> 0.3; code of train changed"
    )


def test_settings_that_come_or_go_many_changes_and_long_values_are_short():
    assert shortened([dumped({"a": 1})], [dumped({"a": 1, "b": None})]) == "train street: b (absent) -> null"
    many = ({f"k{i:02}": value for i in range(20)} for value in ("x" * 500, 1))
    reason = shortened(*([dumped(record)] for record in many))
    assert reason.endswith(f"; and {20 - MAX_CHANGES} more settings") and len(reason) < 1000


def test_other_params_are_shown_as_they_are():
    """The root of a dataset; and params that only one side has."""
    assert shortened(["data/a"], ["data/b"]) == "train street: data/a -> data/b"
    assert shortened([dumped(TRAIN)], [dumped(TRAIN), "more"]) == "train street: (absent) -> more"


@pytest.mark.parametrize("reason", ["Forced execution", "Missing output files: a.npz", "", None])
def test_other_reasons_stay(reason):
    record = logging.makeLogRecord({"reason": reason, "rule_name": "train", "wildcards": {}})
    assert name_changes(record) and record.reason == reason
    assert name_changes(logging.makeLogRecord({}))
