"""Settings of worlds with a route, and what planning makes of them."""

import json
import re

import pytest
import yaml
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.settings.config import load
from drivesplat.settings.world import WorldSettings
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.stages import stage_settings


def config_of(world: dict) -> dict:
    return {"datasets": {"a": {"scenes": ["a"], "world": world}}}


def test_worlds_without_a_route_have_the_settings_that_they_had_before():
    told = json.loads(stage_settings(load({}), "demo_world", "demo"))
    assert "route" not in told["world"] and told["world"]["bend_deg"] == 0.0
    assert "route" not in WorldSettings().model_dump() and WorldSettings.model_validate(told["world"]).route is None
    long = json.loads(stage_settings(load(config_of({"route": {"loop_blocks": 8}})), "demo_world", "a"))
    assert long["world"]["route"] == {"block_m": 84.0, "speed": 12.0, "loop_blocks": 8, "closure": "same"}


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ({"key_frames": 401}, "one street has at most 400; set route"),
        ({"route": {}, "grade": 0.05}, "a world with a route has no grade; leave it out"),
        ({"route": {}, "traffic": "queue", "dogs": 1}, "has no dogs, traffic; leave them out"),
        ({"route": {}, "truth": {"lidar": True}}, "a world with a route has no ground truth; leave out truth"),
        ({"route": {"loop_blocks": 7}}, "multiple of 2"),
    ],
)
def test_settings_that_do_not_fit_are_refused_in_a_sentence(world, message):
    with pytest.raises(ConfigError, match=re.escape(message)) as refusal:
        load(config_of(world))
    assert "\n" not in str(refusal.value) and "datasets.a.world" in str(refusal.value)


@pytest.mark.parametrize("target", ["truth.mp4", "truth.json", "edit_truth/gone.json"])
def test_targets_that_need_truth_are_refused_in_a_sentence(target):
    made = Plan(config_of({"route": {}}), str(REPOSITORY))
    with pytest.raises(ConfigError, match="scene a, and a world with a route has none") as refusal:
        made.refuse_unknown([f"results/a/street/{target}"])
    assert "datasets.a.world.route" in str(refusal.value) and "\n" not in str(refusal.value)


def test_the_example_of_the_documentation_is_a_drive_of_two_minutes():
    page = (REPOSITORY / "docs/world.md").read_text()
    section = page[page.index("## Long drives") : page.index("## The truth")]
    text = "\n".join(line[4:] for line in section.splitlines() if line.startswith("    "))
    world = load(yaml.safe_load(text)).datasets["two_minutes"].world
    assert world.route is not None and world.seconds == 120.0
