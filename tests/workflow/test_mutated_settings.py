"""Values of another kind than a setting wants: the plan refuses them in one sentence, or takes them."""

import copy
import math
from collections.abc import Iterator
from datetime import date, datetime
from types import SimpleNamespace
from typing import Any

import hypothesis
from helpers import REPOSITORY
from hypothesis import strategies as st

from drivesplat.errors import DriveSplatError
from drivesplat.settings.config import Config
from drivesplat.settings.method import merged
from drivesplat.workflow.plan import Plan

MUTATIONS = 100
CIRCLE: dict[str, Any] = {}
CIRCLE["a"] = CIRCLE
VALUES = (
    None, True, False, 0, -1, 10**400, 1e308, math.nan, math.inf, date(2024, 5, 1), datetime(2024, 5, 1, 1, 2, 3),
    b"bytes", "", " ", "a\0b", "\ud800", "x" * 100_000, "../..", "/dev/full", "~nobody-at-all/x", "{scene}", "\n",
    "true", [], [None], [[]], {}, {"a": 1}, {1: 2}, {None: None}, {"a": {"b": [1]}}, CIRCLE,
)  # fmt: skip
"""What YAML can make of a value, and values that no file system or number format has."""
OPTIONAL = {
    "subjects": {"demo": {"track": "a", "key_frame": 1}},
    "datasets": {"demo": {"frames": {"demo": [0, 5]}, "overrides": {"train": {"iterations": 3}}}},
    "methods": {
        "own": {"parts": ["background"], "overrides": {"train": {"iterations": 3}}},
        "built": {"of": "own", "overrides": {"train": {"iterations": 4}}},
    },
    "ablation": {"without": {"own": {"parts": ["background"], "overrides": {"train": {"dropout": 0.1}}}}},
    "render": {"trajectories": {"own": {"lateral": 1.0}}},
    "actors": {"classes": {"pedestrian": ["deformable", "actors"]}},
}
"""Entries that the defaults leave empty."""


def paths(tree: dict[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in tree.items():
        yield (*above, key)
        if isinstance(value, dict):
            yield from paths(value, (*above, key))


def plan(values: dict[str, Any]) -> None:
    """What the Snakefile asks of a config before any job."""
    made, targets = Plan(values, str(REPOSITORY)), ["results/demo/metrics.json"]
    made.refuse_unknown(targets)
    made.edits()
    made.settings("train")(SimpleNamespace(scene="demo", method="vanilla"))
    made.refuse_absent_data(targets)


def test_a_value_of_another_kind_is_refused_in_one_sentence_or_taken(monkeypatch, tmp_path):
    config = merged(Config().model_dump(mode="json"), OPTIONAL)
    (tmp_path / "presets").symlink_to(REPOSITORY / "presets")
    monkeypatch.chdir(tmp_path)
    plan(config)
    refused = 0

    @hypothesis.settings(max_examples=MUTATIONS)
    @hypothesis.given(st.sampled_from(list(paths(config))), st.sampled_from(VALUES))
    def replaced(path: tuple[str, ...], value: Any) -> None:
        nonlocal refused
        values = copy.deepcopy(config)
        at = values
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value
        try:
            plan(values)
        except DriveSplatError as refusal:
            assert "\n" not in str(refusal) and len(str(refusal)) < 1500, (path, value)
            refused += 1

    replaced()
    assert refused > MUTATIONS / 3, "mutations that are refused"
