"""The ablation of a method: what it is without each of the things that make it up, trained with several seeds."""

from collections.abc import Sequence
from typing import Any

from pydantic import Field, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.method import MethodSettings, Seeds, with_seed, with_seeds
from drivesplat.settings.train import Parts


class VariantSettings(Settings):
    """A method with something taken out of it."""

    parts: Parts | None = None
    """What the variant's model is made of. null = what the method's is."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Settings laid over the method's own overrides, as a tree; `sky` and `train` may."""

    @model_validator(mode="after")
    def _takes_something_out(self) -> "VariantSettings":
        if self.parts is None and not self.overrides:
            raise ValueError("it takes nothing out: give it parts or overrides")
        return self


def _default_variants() -> dict[str, VariantSettings | None]:
    def trained(**train: Any) -> VariantSettings:
        return VariantSettings(overrides={"train": train})

    return {
        "actors": VariantSettings(parts=("background",)),
        "track_correction": trained(actors={"tracks": {"corrected": False}}),
        "sky": VariantSettings(overrides={"sky": "none", "train": {"sky_bce_weight": 0.0}}),
        "sky_loss": trained(sky_bce_weight=0.0),
        "depth": trained(depth_weight=0.0),
        "entropy": trained(entropy_weight=0.0),
        "colours_in_time": trained(actors={"fourier": 1}),
        "dynamic_loss": trained(dynamic_weight=0.0),
    }


class AblationSettings(Settings):
    of: str = "street"
    """The method that is taken apart."""
    seeds: Seeds = (0, 1, 2)
    """Random seeds of the trainings: the method and every variant of it are trained with each."""
    without: dict[str, VariantSettings | None] = Field(default_factory=_default_variants)
    """The variants, under names of your choice, by what each is without; null = no such variant. They are methods,
    called {of}-without-{name}-seed{n}; the whole is {of}-seed{n}."""

    @property
    def job(self) -> "AblationJob":
        """What is compared."""
        without = tuple(name for name, variant in self.without.items() if variant is not None)
        return AblationJob(of=self.of, seeds=self.seeds, without=without)

    def methods(self, whole: MethodSettings) -> dict[str, MethodSettings]:
        """The methods to train, by name: `whole` and every variant of it, each with every seed."""
        variants = {
            self.job.variant(name): whole.varied(variant.parts, variant.overrides)
            for name, variant in self.without.items()
            if variant is not None
        }
        return with_seeds({self.of: whole, **variants}, self.seeds)


class AblationJob(Settings):
    """Everything that decides the content of one ablation.json, its inputs aside."""

    of: str
    seeds: tuple[int, ...]
    without: tuple[str, ...]

    def variant(self, without: str | None) -> str:
        """The name of a variant; without nothing, of the whole method."""
        return f"{self.of}-without-{without}" if without else self.of

    def method(self, without: str | None, seed: int) -> str:
        """The name of a variant trained with a seed."""
        return with_seed(self.variant(without), seed)

    @property
    def spelled(self) -> str:
        """The names of all methods, as a shell would expand them."""
        stems = [self.of, *([self.variant(_either(self.without))] if self.without else [])]
        return ", ".join(f"{stem}-seed{_either(self.seeds)}" for stem in stems)


def _either(names: Sequence[Any]) -> str:
    """Names as a shell would expand them: it leaves braces around a single one."""
    spelled = ",".join(map(str, names))
    return f"{{{spelled}}}" if len(names) > 1 else spelled
