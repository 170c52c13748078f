"""The runs in the closed loop, as a YAML file: named runs, of any scenes. docs/closed_loop.md describes it.

This module imports quickly, since the Snakefile imports it.
"""

import hashlib
import re
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

from drivesplat.errors import ConfigError
from drivesplat.io.this_copy import of_the_workflow
from drivesplat.io.yaml_file import read_yaml
from drivesplat.settings import quoted, validated
from drivesplat.settings.blocks import block_scene_name
from drivesplat.settings.config import Config
from drivesplat.settings.names import MAX_LENGTH, NAME
from drivesplat.settings.simulate import RunSettings
from drivesplat.settings.without_boxes import REPLACED
from drivesplat.workflow.film_names import no_such_edit, scene_edits
from drivesplat.workflow.without_tracks import in_place_of_street

RUNS = "runs"
"""The folder of a method with its runs."""


def read_runs(path: str | Path) -> dict[str, RunSettings]:
    """The runs of a file by name, in the file's order. Raises ConfigError, one line with the file and the run, where it
    is missing or invalid."""
    content = read_yaml(path, "runs file")
    if not isinstance(content, dict) or set(content) != {"runs"}:
        raise ConfigError(f"{path}: a runs file holds the one key 'runs', under it settings per name")
    runs = {} if content["runs"] is None else content["runs"]
    if not isinstance(runs, dict):
        raise ConfigError(f"{path}: 'runs' is {quoted(runs)}; it holds settings per name")
    found = {}
    for name, values in runs.items():
        if not isinstance(name, str) or not re.fullmatch(NAME, name) or len(name) > MAX_LENGTH:
            raise ConfigError(f"{path}: run {quoted(name)} cannot name a file: use letters, digits, '_', '-' and '.'")
        if not isinstance(values, dict):
            raise ConfigError(f"{path}: run {name!r} is {quoted(values)}; it is a mapping: policy: pure_pursuit, ...")
        found[name] = validated(RunSettings, values, f"{path}: run {name!r}: ")
    return found


def config_runs(config: Config) -> dict[str, RunSettings]:
    """The runs of the config by name; none without a runs file."""
    return {} if config.runs is None else read_runs(of_the_workflow(config.runs))


def runs_of(config: Config, scene: str, method: str) -> dict[str, RunSettings]:
    """The runs of a method on a scene by name; those of `street` are also runs of the method in its place, without
    edits if it knows no objects. Raises ConfigError where one names a scene, a method or an edit that is not there."""
    found = {}
    replaces, has_objects = in_place_of_street(config, scene) == method, config.all_methods[method].object_parts
    for name, run in config_runs(config).items():
        for other in run.scenes or ():
            config.dataset_of(other)
            if config.is_cut(other):
                raise ConfigError(
                    f"run {name!r}: scene {other} is cut into blocks, and a policy drives in one block: name it, "
                    f"such as {block_scene_name(other, 0)}"
                )
        unknown = [other for other in run.methods if other not in config.all_methods]
        if unknown:
            raise ConfigError(
                f"run {name!r}: there is no method {unknown[0]!r}; there are: {', '.join(config.methods)}"
            )
        by_replaced = replaces and REPLACED in run.methods and (run.edit is None or has_objects)
        if not (method in run.methods or by_replaced) or (run.scenes is not None and scene not in run.scenes):
            continue
        edits = scene_edits(config, scene) if run.edit is not None else {}
        if run.edit is not None and run.edit not in edits:
            if run.scenes is not None:
                raise ConfigError(f"run {name!r}: {no_such_edit(scene, run.edit, edits)}")
            continue
        found[name] = run
    return found


def no_such_run(scene: str, method: str, name: str, runs: Iterable[str]) -> str:
    """The message about an unknown run of a method on a scene."""
    known = ", ".join(runs) or "none"
    return f"method {method} has no run called {name!r} on scene {scene}; there are: {known} (`runs` names the file)"


def code_of(policy: str) -> str | None:
    """A digest of the file of an entry point's module, so that changed code drives again; None for a policy of this
    package, and where the module is not found."""
    module, _, attribute = policy.partition(":")
    if not attribute or module.split(".")[0] == "drivesplat":
        return None
    try:
        spec = find_spec(module)
    except Exception:  # of a package around the module, which is imported
        return None
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        return None
    return hashlib.sha256(Path(spec.origin).read_bytes()).hexdigest()
