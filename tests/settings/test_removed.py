"""Config files that name a removed setting: one line that says so and why."""

import pytest

from drivesplat.errors import ConfigError
from drivesplat.settings.config import Config, load
from drivesplat.settings.removed import FORMER_DEFAULTS, REMOVED


def tree(key: str, value: object = 0.5) -> dict:
    """A config with a value at a dotted key."""
    for part in reversed(key.split(".")):
        value = {part: value}
    return value


@pytest.mark.parametrize("key", REMOVED)
def test_a_config_with_a_removed_setting_is_refused_with_its_reason(key):
    with pytest.raises(ConfigError) as error:
        load(tree(key))
    message = str(error.value)
    assert f"'{key}' was removed: {REMOVED[key]}" in message and "\n" not in message


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"methods": {"mine": {"overrides": tree("train.mcmc.growth")}}}, "methods.mine.overrides.train.mcmc.growth"),
        ({"datasets": {"a": {"overrides": tree("free_space", {"voxel": 1.0})}}}, "datasets.a.overrides.free_space"),
        (
            {"ablation": {"without": {"it": {"overrides": tree("train.camera_poses")}}}},
            "ablation.without.it.overrides.train.camera_poses",
        ),
    ],
)
def test_overrides_with_a_removed_setting_are_refused_by_their_full_name(values, named):
    with pytest.raises(ConfigError, match=f"'{named}' was removed"):
        load(values)


def test_every_removed_setting_may_stand_at_its_former_default():
    assert FORMER_DEFAULTS.keys() == REMOVED.keys()
    for key, default in FORMER_DEFAULTS.items():
        assert load(tree(key, default)) == Config(), key


def test_no_removed_setting_exists():
    """What is there again has to leave the table."""
    for key in REMOVED:
        known = Config().model_dump()
        for part in key.split("."):
            known = known.get(part, {}) if isinstance(known, dict) else {}
        assert known == {}, key
