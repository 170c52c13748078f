"""Snakemake's reasons for jobs: changed settings by name, and the text that they are taken from."""

import json
import logging

from snakemake.jobs import Reason
from snakemake.persistence import ParamsChange

from drivesplat.workflow.snakemake_log import name_changes

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


def test_a_changed_setting_is_named_with_its_values_and_changed_code_by_its_rule():
    assert shortened([dumped(TRAIN), CODE], [dumped(OTHER), CODE]) == "train street: train.ssim_weight 0.2 -> 0.3"
    assert shortened([CODE], [NEW_CODE], method=None) == "train: code of train changed"
    changed = shortened([dumped(TRAIN), CODE], [dumped(OTHER), NEW_CODE], input_changed=True)
    assert changed == (
        "Set of input files has changed since last execution; "
        "train street: train.ssim_weight 0.2 -> 0.3; code of train changed"
    )


def test_other_params_are_shown_as_they_are():
    """The root of a dataset; and params that only one side has."""
    assert shortened(["data/a"], ["data/b"]) == "train street: data/a -> data/b"
    assert shortened([dumped(TRAIN)], [dumped(TRAIN), "more"]) == "train street: (absent) -> more"
