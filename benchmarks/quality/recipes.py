"""Recipe files (docs/quality.md). Recipes become methods; those with the same scene settings share a Snakemake run."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from benchmarks.files import SHARED_SETTINGS, BenchmarkFile, error_prefix, read_file
from benchmarks.snakemake_run import ConfigLayers, SnakemakeRun
from drivesplat.errors import ConfigError
from drivesplat.io.storage import canonical_json, sha256_text
from drivesplat.settings import Settings
from drivesplat.settings.config import load, require_known
from drivesplat.settings.dataset import DatasetSettings
from drivesplat.settings.method import VARIATION_OVERRIDES, MethodSettings, with_seed
from drivesplat.settings.names import require_name
from drivesplat.settings.train import Parts
from drivesplat.workflow.stages import stage_settings

SCENE_SETTINGS = tuple(key for key in SHARED_SETTINGS if key not in (*VARIATION_OVERRIDES, "methods"))
"""The sections that `config` of one recipe may set; its `overrides` set the others."""


class Recipe(Settings):
    of: str | None = None
    """The method of the config to start from. null = a background with the settings of the config."""
    parts: Parts | None = None
    """The parts of the model. null = those of that method."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Settings laid over that method's own overrides, as a tree; `sky` and `train` may."""
    config: dict[str, Any] = Field(default_factory=dict)
    """Scene settings that differ for this recipe, as a tree: lidar_seed, sweeps, cameras, datasets, ... Recipes with
    equal trees share the preprocessed scene."""

    def method(self, name: str, methods: Mapping[str, MethodSettings]) -> MethodSettings:
        """The recipe `name` as a method; `methods` are those of the config. Raises ConfigError if `of` is not one."""
        if self.of is not None and self.of not in methods:
            raise ConfigError(f"{name!r} is of {self.of!r}, which is no method of the config: {', '.join(methods)}")
        start = MethodSettings() if self.of is None else methods[self.of]
        return start.varied(self.parts, self.overrides)


class RecipeFile(BenchmarkFile):
    recipes: dict[str, Recipe | None] = Field(min_length=1)
    """The recipes by name, in the order of the table; the first is the reference. null = no such recipe."""

    @field_validator("recipes")
    @classmethod
    def _null_is_no_recipe(cls, value: dict[str, Recipe | None]) -> dict[str, Recipe | None]:
        wanted = {name: recipe for name, recipe in value.items() if recipe is not None}
        if not wanted:
            raise ValueError("no recipe is left; keep one")
        return wanted


def read_recipes(path: str | Path) -> RecipeFile:
    """The recipes of a file. Raises ConfigError, in one line that names the file, if it is missing or invalid."""
    file = read_file(path, RecipeFile, "docs/quality.md")
    with error_prefix(str(path)):
        for name, recipe in file.recipes.items():
            require_name(name, "recipe")
            require_known(recipe.overrides, VARIATION_OVERRIDES, f"recipes.{name}.overrides")
            require_known(recipe.config, SCENE_SETTINGS, f"recipes.{name}.config")
    return file


def plan_runs(file: RecipeFile, out: Path, workflow: Path) -> list[SnakemakeRun]:
    """A run for every set of recipes with equal scene settings, in the order of their first ones, with results below
    `out`; `workflow` is the Snakefile's folder.

    Raises ConfigError if a recipe is invalid or trains the same as another, or if two make different synthetic worlds
    in one folder.
    """
    layers = ConfigLayers.of(file, workflow)
    by_settings: dict[str, dict[str, Recipe]] = {}
    for name, recipe in file.recipes.items():
        by_settings.setdefault(canonical_json(recipe.config), {})[name] = recipe
    runs = []
    for recipes in by_settings.values():
        with error_prefix(f"recipe{'s' * (len(recipes) > 1)} {', '.join(recipes)}"):
            runs.append(_planned(file, recipes, layers, out, workflow))
    _refuse_twins(runs)
    _refuse_two_worlds(runs)
    return runs


def _planned(
    file: RecipeFile, recipes: Mapping[str, Recipe], layers: ConfigLayers, out: Path, workflow: Path
) -> SnakemakeRun:
    """The run of `recipes`, whose scene settings are equal."""
    tree = next(iter(recipes.values())).config
    layers = layers.with_scene_settings(tree, file.scene)
    known = load(layers.values).methods
    methods = {name: recipe.method(name, known) for name, recipe in recipes.items()}
    return SnakemakeRun.of(layers, file, methods, out / _folder_name(tree), workflow)


def _folder_name(tree: Mapping[str, Any]) -> str:
    """The folder of recipes with these scene settings; it does not depend on other recipes."""
    return "-".join([*sorted(tree), sha256_text(canonical_json(tree))[:6]]) if tree else "plain"


def _dataset(run: SnakemakeRun) -> DatasetSettings:
    return run.plan.config.datasets[run.plan.config.dataset_of(run.scene)]


def _refuse_twins(runs: list[SnakemakeRun]) -> None:
    """Raises ConfigError if two recipes would train the same."""
    known: dict[str, str] = {}
    for run in runs:
        source = [_dataset(run).dataroot, _world(run)]
        for recipe in run.methods:
            stages = run.plan.evaluation_stages(run.scene, [with_seed(recipe, run.seeds[0])])
            settings = {name.rpartition("/")[2]: stage["settings"] for name, stage in stages.items()}
            other = known.setdefault(canonical_json([settings, source]), recipe)
            if other != recipe:
                raise ConfigError(
                    f"recipes {other!r} and {recipe!r} train the same on scene {run.scene}; drop one, or check whether "
                    "what it sets is the default already"
                )


def _world(run: SnakemakeRun) -> dict[str, Any] | None:
    """The settings that generate a run's synthetic world; None for a recorded drive."""
    if _dataset(run).world is None:
        return None
    return json.loads(stage_settings(run.plan.config, "demo_world", run.scene))


def _refuse_two_worlds(runs: list[SnakemakeRun]) -> None:
    """Raises ConfigError if two runs would make different synthetic worlds in one folder, in turns."""
    makers: dict[Path, tuple[str, dict[str, Any]]] = {}
    for run in runs:
        recipe, dataset, world = run.methods[0], _dataset(run), _world(run)
        if world is None:
            continue
        first, made = makers.setdefault(Path(dataset.world_root).resolve(), (recipe, world))
        if made == world:
            continue
        sensors = {name: made["world"][name] for name in ("cameras", "sweeps")}
        same_street = made == {**world, "world": {**world["world"], **sensors}}
        raise ConfigError(
            f"recipes {first!r} and {recipe!r} make different worlds in {dataset.dataroot}; give each a dataroot of "
            f"its own{', or set world.cameras and world.sweeps to the same sensors in both' * same_street}"
        )
