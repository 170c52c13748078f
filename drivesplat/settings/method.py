"""What a method is, and what is made of one: variations of it, and trainings with several random seeds."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from drivesplat.settings import Settings
from drivesplat.settings.overrides import merged
from drivesplat.settings.train import Parts


class MethodSettings(Settings):
    parts: Parts = ("background",)
    """What the model is made of; a background is always among it."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Settings of this file that differ for this method, as a tree; `sky`, `train` and `random_seed` (of its training)
    may."""

    def varied(self, parts: Parts | None, overrides: Mapping[str, Any]) -> "MethodSettings":
        """Itself with other parts, where some are given, and `overrides` laid over its own."""
        return MethodSettings(parts=parts or self.parts, overrides=merged(self.overrides, overrides))


VARIATION_OVERRIDES = ("sky", "train")
"""What a variation of a method may set: what its training alone decides. Seeds are set for it."""


def _each_once(seeds: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(seeds)) != len(seeds):
        raise ValueError("it names a seed twice")
    return seeds


Seeds = Annotated[tuple[Annotated[int, Field(ge=0, lt=2**31)], ...], Field(min_length=1), AfterValidator(_each_once)]
"""Random seeds of trainings that are compared."""


def with_seed(method: str, seed: int) -> str:
    """The name of a method trained with a seed."""
    return f"{method}-seed{seed}"


def with_seeds(methods: Mapping[str, MethodSettings], seeds: Iterable[int]) -> dict[str, MethodSettings]:
    """Every method as one method a seed, by name."""
    return {
        with_seed(name, seed): method.varied(None, {"random_seed": seed})
        for name, method in methods.items()
        for seed in seeds
    }
