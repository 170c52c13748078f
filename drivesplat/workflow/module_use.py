"""The workflow as a part of another one, which imports it by Snakemake's `module` statement (docs/installation.md).

It reads Snakemake's state of a module, which is no documented interface: tests/workflow/test_module_use.py fails where
that changes.
"""

import sys
from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

from snakemake.path_modifier import PathModifier

from drivesplat.errors import ConfigError, DriveSplatError
from drivesplat.io.yaml_file import read_yaml
from drivesplat.settings import quoted
from drivesplat.settings.config import load
from drivesplat.settings.method import merged
from drivesplat.workflow.plan import Plan


def take_prefix(workflow: Any) -> str:
    """The prefix of the files of this module, empty without one; from here on Snakemake puts it before no path.

    The plan puts it before the results folder and the worlds instead: Snakemake would put it before the paths of
    recorded datasets, too, and the plan reads results itself. Raises ConfigError where the module statement replaces
    prefixes.
    """
    modifier, prefixes = workflow.modifier.path_modifier, []
    while modifier is not None:
        if modifier.modifies_prefixes:
            raise ConfigError("the module statement has replace_prefix; give it a prefix, or its config a results_dir")
        prefixes.insert(0, modifier.prefix or "")
        modifier = modifier.inner_modifier
    workflow.modifier.path_modifier = PathModifier(None, None, workflow)
    return str(Path(*prefixes)) if any(prefixes) else ""


def module_config(config: Any, defaults: str | Path, prefix: str) -> dict[str, Any]:
    """The settings of a module: its `config` laid over the workflow's own config.yaml, `defaults`, with the `prefix`
    before the relative paths of what the workflow makes. Raises ConfigError where a setting is invalid."""
    if not isinstance(config, Mapping):
        raise ConfigError(f"the config of the module statement is {quoted(config)}; it must be a mapping of settings")
    values = deepcopy(merged(read_yaml(defaults, "config file"), config))
    load(values)
    values["results_dir"] = str(Path(prefix, Path(values["results_dir"]).expanduser()))
    for dataset in values["datasets"].values():
        if dataset.get("world") is not None:
            dataset["dataroot"] = str(Path(prefix, Path(dataset["dataroot"]).expanduser()))
    return values


def stop_at_absent_data(plan: Plan) -> None:
    """Has the input functions that look for a dataset end the process with one line where it is absent: nothing else
    refuses that for a module, whose targets are unknown at planning."""

    def stopping(function: Callable[[Any], Any], wildcards: Any) -> Any:
        try:
            return function(wildcards)
        except DriveSplatError as error:
            sys.exit(f"drivesplat: {error}")

    for name in ("tables", "scene_tables", "root"):
        setattr(plan, name, partial(stopping, getattr(plan, name)))
