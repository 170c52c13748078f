"""Recipes that are compared on one scene: what a file for `python -m benchmarks.quality` may hold (docs/quality.md)."""

from collections.abc import Mapping
from typing import Any

from pydantic import Field, field_validator

from drivesplat.settings import Settings
from drivesplat.settings.method import MethodSettings, Seeds
from drivesplat.settings.names import require_text
from drivesplat.settings.train import Parts


class Recipe(Settings):
    of: str | None = None
    """A method of the config that the recipe starts from. null = a background with the settings of the config."""
    parts: Parts | None = None
    """What its model is made of. null = what that method's is."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Settings laid over that method's own overrides, as a tree; `sky` and `train` may."""
    config: dict[str, Any] = Field(default_factory=dict)
    """Settings of the whole scene that differ for this recipe, as a tree: lidar_seed, sweeps, cameras, datasets, ...
    Recipes with the same tree share what is made of the scene."""

    def method(self, methods: Mapping[str, MethodSettings]) -> MethodSettings:
        """The recipe as a method; `methods` are those of the config. Raises KeyError where `of` is none of them."""
        start = MethodSettings() if self.of is None else methods[self.of]
        return start.varied(self.parts, self.overrides)


class RecipeFile(Settings):
    base: tuple[str, ...] = ()
    """Config files laid over config.yaml, each over those before it, as with Snakemake's --configfile."""
    config: dict[str, Any] = Field(default_factory=dict)
    """Settings for all recipes, as a tree, laid over these; they hold over what a dataset sets for itself, too."""
    scene: str
    """The scene that all recipes are trained on; quoted."""
    seeds: Seeds = (0, 1, 2)
    """Random seeds of the trainings: every recipe is trained with each."""
    recipes: dict[str, Recipe | None] = Field(min_length=1)
    """The recipes, under names of your choice, in the order of the table; others are held to the first. null = no such
    recipe."""

    @field_validator("scene", mode="before")
    @classmethod
    def _is_quoted(cls, value: Any) -> Any:
        require_text(value)
        return value

    @field_validator("recipes")
    @classmethod
    def _none_is_no_recipe(cls, value: dict[str, Recipe | None]) -> dict[str, Recipe | None]:
        wanted = {name: recipe for name, recipe in value.items() if recipe is not None}
        if not wanted:
            raise ValueError("no recipe is left; keep one")
        return wanted
