"""A file of recipes as groups: recipes that share the settings of their scene share a results folder and one run of
Snakemake, which sees a method for every recipe and seed."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

from benchmarks.quality.recipes import Recipe, RecipeFile
from drivesplat.errors import ConfigError
from drivesplat.io.storage import canonical_json, sha256_text
from drivesplat.settings import validated
from drivesplat.settings.config import DATASET_OVERRIDES, load, require_known
from drivesplat.settings.dataset import DatasetSettings
from drivesplat.settings.method import VARIATION_OVERRIDES, MethodSettings, with_seed, with_seeds
from drivesplat.settings.names import require_name
from drivesplat.settings.overrides import merged
from drivesplat.settings.yaml_file import read_yaml
from drivesplat.workflow.plan import Plan

DOCUMENT = "docs/quality.md"
SHARED = (*DATASET_OVERRIDES, "datasets", "methods", "subjects", "lpips", "random_seed")
"""What the config of all recipes may set."""
OWN = tuple(key for key in SHARED if key not in (*VARIATION_OVERRIDES, "methods"))
"""What the config of one recipe may set: of the rest, its overrides."""


@dataclass(frozen=True)
class Group:
    """Recipes that share the settings of their scene: their names, the plan of the config that holds for them, and
    `overlay`, what of it is laid over config.yaml."""

    scene: str
    seeds: tuple[int, ...]
    recipes: tuple[str, ...]
    plan: Plan
    overlay: dict[str, Any]

    @property
    def folder(self) -> Path:
        """Where its results lie."""
        return Path(self.plan.config.results_dir)

    @property
    def dataset(self) -> DatasetSettings:
        """What its scene belongs to."""
        return self.plan.config.datasets[self.plan.config.dataset_of(self.scene)]

    @property
    def targets(self) -> list[Path]:
        """The eval.json of every recipe with every seed."""
        return [self.evaluation(recipe, seed) for recipe in self.recipes for seed in self.seeds]

    def evaluation(self, recipe: str, seed: int) -> Path:
        """Where the figures of a recipe with a seed lie."""
        return self.folder / self.scene / with_seed(recipe, seed) / "eval.json"

    def log(self, recipe: str, seed: int, stage: str) -> Path:
        """What a stage of a recipe with a seed has logged."""
        return self.folder / "logs" / self.scene / with_seed(recipe, seed) / f"{stage}.log"


def read_recipes(path: str | Path) -> RecipeFile:
    """The recipes of a file. Raises ConfigError, one line with the file, where it is missing or not what it should
    be."""
    content = read_yaml(path, "recipe file")
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: a recipe file holds scene, seeds and recipes; {DOCUMENT} describes it")
    with told_of(str(path)):
        recipes = validated(RecipeFile, content, "", DOCUMENT)
        require_known(recipes.config, SHARED, "config")
        for name, recipe in recipes.recipes.items():
            require_name(name, "recipe")
            require_known(recipe.overrides, VARIATION_OVERRIDES, f"recipes.{name}.overrides")
            require_known(recipe.config, OWN, f"recipes.{name}.config")
    return recipes


@dataclass(frozen=True)
class Layers:
    """Settings laid over those of config.yaml."""

    default: Mapping[str, Any]
    laid: Mapping[str, Any]

    @property
    def values(self) -> dict[str, Any]:
        """What both come to."""
        return merged(self.default, self.laid)

    def under(self, tree: Mapping[str, Any]) -> "Layers":
        """With a further tree over them."""
        return Layers(self.default, merged(self.laid, tree))

    def everywhere_under(self, tree: Mapping[str, Any], scene: str) -> "Layers":
        """With a further tree over them, and over what the dataset of `scene` sets for itself."""
        own = {key: value for key, value in tree.items() if key in DATASET_OVERRIDES}
        layers = self.under({key: value for key, value in tree.items() if key not in own})
        dataset = load(layers.values).dataset_of(scene)
        return layers.under({"datasets": {dataset: {"overrides": own}}}) if own else layers


def layers_of(
    base: Iterable[str], config: Mapping[str, Any], scene: str, workflow: Path, where: str = "base and config"
) -> Layers:
    """The settings of config.yaml in the folder `workflow` with the config files of `base` laid over them, and the tree
    `config` over all, what the dataset of `scene` sets for itself included.

    Raises ConfigError, which begins with `where`, where they are not valid.
    """
    laid = reduce(merged, (_config_file(Path(path).expanduser()) for path in base), {})
    with told_of(where):
        layers = Layers(_config_file(workflow / "config.yaml"), laid).everywhere_under(config, scene)
        load(layers.values)
    return layers


def groups_of(recipes: RecipeFile, out: Path, workflow: Path) -> list[Group]:
    """The groups of recipes, in the order of their first ones, with results below `out`; `workflow` is the Snakefile's
    folder. Paths of config files count from the current folder, as Snakemake's do.

    Raises ConfigError where a recipe is not valid, comes to the same as another, or would make another's world anew.
    """
    shared = layers_of(recipes.base, recipes.config, recipes.scene, workflow, "base and config of all recipes")
    together: dict[str, dict[str, Recipe]] = {}
    for name, recipe in recipes.recipes.items():
        together.setdefault(canonical_json(recipe.config), {})[name] = recipe
    groups = []
    for members in together.values():
        with told_of(f"recipe{'s' * (len(members) > 1)} {', '.join(members)}"):
            groups.append(_group(recipes, members, shared, out, workflow))
    _refuse_twins(groups)
    _refuse_two_worlds(groups)
    return groups


def _group(recipes: RecipeFile, members: Mapping[str, Recipe], shared: Layers, out: Path, workflow: Path) -> Group:
    """The group of `members`, whose config is the same, over what all recipes share."""
    tree = next(iter(members.values())).config
    layers = shared.everywhere_under(tree, recipes.scene)
    known = load(layers.values).methods
    methods = with_seeds({name: _method(name, recipe, known) for name, recipe in members.items()}, recipes.seeds)
    wanted = {name: method.model_dump(mode="json") for name, method in methods.items()}
    results = {"results_dir": str(out / _folder_name(tree))}
    made = layers.under({"methods": dict.fromkeys(known) | wanted, **results})
    return Group(recipes.scene, recipes.seeds, tuple(members), Plan(made.values, str(workflow)), dict(made.laid))


def _method(name: str, recipe: Recipe, known: Mapping[str, MethodSettings]) -> MethodSettings:
    try:
        return recipe.method(known)
    except KeyError:
        there = ", ".join(known)
        raise ConfigError(
            f"{name!r} is of {recipe.of!r}, which is no method of the config; there are: {there}"
        ) from None


def _folder_name(tree: Mapping[str, Any]) -> str:
    """What recipes with this config call their folder: the same whatever other recipes there are."""
    return "-".join([*sorted(tree), sha256_text(canonical_json(tree))[:6]]) if tree else "plain"


def _refuse_twins(groups: list[Group]) -> None:
    """Raises ConfigError where two recipes would train one thing twice."""
    known: dict[str, str] = {}
    for group in groups:
        for recipe in group.recipes:
            method = with_seed(recipe, group.seeds[0])
            stages = group.plan.evaluation_stages(group.scene, [method])
            told = {name.rpartition("/")[2]: stage["settings"] for name, stage in stages.items()}
            source = group.dataset.model_dump(mode="json", include={"dataroot", "world"})
            other = known.setdefault(canonical_json([told, source]), recipe)
            if other != recipe:
                raise ConfigError(
                    f"recipes {other!r} and {recipe!r} come to the same on scene {group.scene}; drop one, or look at "
                    "what they set: what is there already changes nothing"
                )


def _refuse_two_worlds(groups: list[Group]) -> None:
    """Raises ConfigError where the runs of two groups would make two worlds in one folder, by turns."""
    makers: dict[Path, Group] = {}
    for group in groups:
        if group.dataset.world is None:
            continue
        first = makers.setdefault(Path(group.dataset.world_root).resolve(), group)
        if first.dataset.world != group.dataset.world:
            raise ConfigError(
                f"recipes {first.recipes[0]!r} and {group.recipes[0]!r} make different worlds in "
                f"{group.dataset.dataroot}; give each a dataroot of its own"
            )


def _config_file(path: Path) -> dict[str, Any]:
    content = read_yaml(path, "config file")
    if content is not None and not isinstance(content, dict):
        raise ConfigError(f"{path}: a config file holds settings by their names, as config.yaml does")
    return content or {}


@contextmanager
def told_of(where: str) -> Iterator[None]:
    """Puts `where` before the message of what is refused."""
    try:
        yield
    except (ConfigError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from None
