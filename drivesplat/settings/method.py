"""Settings of a method, its variations, and its trainings with several random seeds."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.names import suggestion
from drivesplat.settings.tracks import Tracks
from drivesplat.settings.train import MOVING_PARTS, STAGE_OF_PART, PartName, Parts


def merged(base: Mapping[Any, Any], overrides: Mapping[Any, Any]) -> dict[Any, Any]:
    """`base` with `overrides` laid over it; mappings are merged key by key."""
    result = dict(base)
    for key, value in overrides.items():
        both = isinstance(value, Mapping) and isinstance(result.get(key), Mapping)
        result[key] = merged(result[key], value) if both else value
    return result


class MethodSettings(Settings):
    of: str | None = None
    """:printed: Method to build on: `parts` and `tracks` that are not given are its, and `overrides` are laid over its
    own. vanilla and street can be built on even where they are dropped."""
    parts: Parts = ("background",)
    """:printed: Parts of the model. Must contain 'background'."""
    tracks: Tracks = "annotated"
    """:printed: Tracks to train with: 'annotated', 'discovered' (moving objects found in LiDAR scans) or 'none'.
    Metrics use annotated tracks whatever a method trains with. docs/without_boxes.md"""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """:printed: Settings that differ for this method, as a tree. Only `sky`, `train` and `random_seed` (of its
    training) may be set."""

    @model_validator(mode="after")
    def _actors_need_tracks(self) -> "MethodSettings":
        if self.tracks == "none" and self.object_parts:
            raise ValueError(
                f"tracks: none leaves the part {self.object_parts[0]!r} without objects; write tracks: discovered, or "
                "drop the part"
            )
        return self

    @property
    def moving_parts(self) -> tuple[PartName, ...]:
        """Those of its parts whose Gaussians are dynamic: films can show them apart from what is static."""
        return tuple(part for part in self.parts if part in MOVING_PARTS)

    @property
    def object_parts(self) -> tuple[PartName, ...]:
        """Those of its parts whose Gaussians are objects that move: edits know these objects."""
        return tuple(part for part in self.parts if part in STAGE_OF_PART)

    def varied(self, parts: Parts | None, overrides: Mapping[str, Any]) -> "MethodSettings":
        """This method with other `parts`, unless None, and with `overrides` laid over its own."""
        own = parts or self.parts
        return MethodSettings(parts=own, tracks=self.tracks, overrides=merged(self.overrides, overrides))


def default_methods() -> dict[str, MethodSettings]:
    """The methods that the workflow ships with."""
    overrides = {
        "train": {
            "sky_bce_weight": 0.05,
            "horizon_weight": 0.05,
            "depth_weight": 0.01,
            "semantic_weight": 0.1,
            "road_weight": 1.0,
            "road": {"surface": "lidar"},
            "dropout": 0.2,
        }
    }
    parts: Parts = ("background", "road", "actors")
    return {"vanilla": MethodSettings(), "street": MethodSettings(parts=parts, overrides=overrides)}


def built(methods: Mapping[Any, Any], shipped: Mapping[str, Mapping[str, Any]]) -> dict[Any, Any]:
    """The trees of `methods` as YAML has them, with what each method takes from the one that it is `of` written out.

    `shipped` are the trees of methods that can be built on even where `methods` drops them. What is no tree of a method
    stays as it is, to be refused by the validation. Raises ValueError for a method of one that does not exist, and
    where methods are of each other in a circle.

    >>> built({"street": {"tracks": "none"}, "mine": {"of": "street", "parts": ["background"]}}, {})["mine"]
    {'tracks': 'none', 'parts': ['background']}
    """

    def written_out(name: Any, derived: tuple[Any, ...]) -> Any:
        if name in derived:
            circle = " of ".join(map(repr, (*derived[derived.index(name) :], name)))
            raise ValueError(f"methods cannot be of each other in a circle: {circle}")
        tree = methods.get(name)
        tree = shipped.get(name) if tree is None and derived else tree
        if derived and tree is None:
            known = [other for other in {**shipped, **methods} if other in shipped or methods[other] is not None]
            raise ValueError(
                f"method {derived[-1]!r} is of {name!r}, which is no method of the config; "
                f"{suggestion(name, known)}there are: {', '.join(known)}"
            )
        if not isinstance(tree, Mapping) or not isinstance(tree.get("of"), str):
            return tree
        base = written_out(tree["of"], (*derived, name))
        own = {key: value for key, value in tree.items() if key != "of"}
        return merged(base, own) if isinstance(base, Mapping) else own

    return {name: written_out(name, ()) for name in methods}


VARIATION_OVERRIDES = ("sky", "train")
"""Settings that a variation of a method may override. Seeds are set separately."""


def _no_duplicates(seeds: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(seeds)) != len(seeds):
        raise ValueError("it names a seed twice")
    return seeds


Seeds = Annotated[
    tuple[Annotated[int, Field(ge=0, lt=2**31)], ...], Field(min_length=1), AfterValidator(_no_duplicates)
]
"""Random seeds of compared trainings, without repetition."""


def with_seed(method: str, seed: int) -> str:
    """The name of a method's training with one seed."""
    return f"{method}-seed{seed}"


def with_seeds(methods: Mapping[str, MethodSettings], seeds: Iterable[int]) -> dict[str, MethodSettings]:
    """One method per method and seed, by name."""
    return {
        with_seed(name, seed): method.model_copy(update={"overrides": {**method.overrides, "random_seed": seed}})
        for name, method in methods.items()
        for seed in seeds
    }
