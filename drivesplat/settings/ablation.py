"""The ablation of a method: the method without one of its components at a time, trained with several seeds."""

from collections.abc import Sequence
from typing import Any

from pydantic import Field, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.method import MethodSettings, Seeds, with_seed, with_seeds
from drivesplat.settings.train import PartName, Parts


class VariantSettings(Settings):
    """A method without one of its components."""

    parts: Parts | None = None
    """Parts of the variant's model. null = the method's, without those of `drop`."""
    drop: tuple[PartName, ...] = ()
    """:printed: Parts of the method that the variant's model lacks."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """:printed: Settings laid over the method's overrides, as a tree. Only `sky` and `train` may be set."""

    @model_validator(mode="after")
    def _removes_something(self) -> "VariantSettings":
        if self.parts is None and not (self.drop or self.overrides):
            raise ValueError("it removes nothing: set drop, parts or overrides")
        return self

    def parts_of(self, complete: MethodSettings) -> Parts:
        """The parts of the variant of a method."""
        return self.parts or tuple(part for part in complete.parts if part not in self.drop)


def _default_variants() -> dict[str, VariantSettings | None]:
    def trained(*drop: PartName, **train: Any) -> VariantSettings:
        return VariantSettings(drop=drop, overrides={"train": train} if train else {})

    return {
        "actors": trained("actors", "deformable"),
        "track_correction": trained(actors={"tracks": {"corrected": False}}),
        "sky": VariantSettings(overrides={"sky": "none", "train": {"sky_bce_weight": 0.0}}),
        "sky_loss": trained(sky_bce_weight=0.0),
        "depth": trained(depth_weight=0.0),
        "road": trained("road"),
        "ground": trained("road", road_weight=0.0),
        "dropout": trained(dropout=0.0),
        "entropy": trained(entropy_weight=0.0),
        "colours_in_time": trained(actors={"fourier": 1}),
        "dynamic_loss": trained(dynamic_weight=0.0),
    }


class AblationSettings(Settings):
    of: str = "street"
    """:printed: The method to ablate."""
    seeds: Seeds = (0, 1, 2)
    """:printed: Random seeds. The method and every variant are trained once with each seed."""
    without: dict[str, VariantSettings | None] = Field(default_factory=_default_variants)
    """:printed: The variants, each named after the component that it lacks. null drops a variant. Each variant is a
    method named {of}-without-{name}-seed{n}; the complete method is {of}-seed{n}."""

    @property
    def job(self) -> "AblationJob":
        """The comparison of these trainings."""
        without = tuple(name for name, variant in self.without.items() if variant is not None)
        return AblationJob(of=self.of, seeds=self.seeds, without=without)

    def methods(self, complete: MethodSettings) -> dict[str, MethodSettings]:
        """The methods to train, by name: `complete` and every variant, each with every seed."""
        variants = {
            self.job.variant(name): complete.varied(variant.parts_of(complete), variant.overrides)
            for name, variant in self.without.items()
            if variant is not None
        }
        return with_seeds({self.of: complete, **variants}, self.seeds)


class AblationJob(Settings):
    """All settings that determine one ablation.json."""

    of: str
    seeds: tuple[int, ...]
    without: tuple[str, ...]

    def variant(self, without: str | None) -> str:
        """The name of the variant that lacks `without`; of the complete method where it is None."""
        return f"{self.of}-without-{without}" if without else self.of

    def method(self, without: str | None, seed: int) -> str:
        """The name of a variant's training with one seed."""
        return with_seed(self.variant(without), seed)

    @property
    def name_pattern(self) -> str:
        """The names of all methods, as one pattern with braces of the shell."""
        stems = [self.of, *([self.variant(_alternatives(self.without))] if self.without else [])]
        return ", ".join(f"{stem}-seed{_alternatives(self.seeds)}" for stem in stems)


def _alternatives(names: Sequence[Any]) -> str:
    """Names in braces of the shell; a single name without braces, which the shell would not expand."""
    alternatives = ",".join(map(str, names))
    return f"{{{alternatives}}}" if len(names) > 1 else alternatives
