"""Speed files (docs/speed.md): which trainings are timed."""

from typing import Annotated, Any

from pydantic import AfterValidator, Field

from benchmarks.files import BenchmarkFile
from benchmarks.speed.plain import PlainName

OURS = "ours"
"""The recipe that is the method of the config."""


def _distinct(kind: str) -> AfterValidator:
    """Refuses a tuple of the `kind` that holds a value twice."""

    def check(values: tuple[Any, ...]) -> tuple[Any, ...]:
        if len(set(values)) != len(values):
            raise ValueError(f"it names a {kind} twice")
        return values

    return AfterValidator(check)


def _plain_first(names: tuple[PlainName, ...]) -> tuple[PlainName, ...]:
    if names[:1] != ("plain",):
        raise ValueError("it begins with 'plain', which all others are compared with")
    return names


class SpeedFile(BenchmarkFile):
    method: str = "vanilla"
    """The method of the config that is compared with the plain recipe."""
    baselines: Annotated[tuple[PlainName, ...], AfterValidator(_plain_first), _distinct("recipe")] = ("plain",)
    """The plain recipe, and variants of it: 'plain_packed' (needs a GPU), 'plain_sky'."""
    iterations: Annotated[
        tuple[Annotated[int, Field(ge=1, le=1_000_000)], ...], Field(min_length=1), _distinct("length")
    ] = (30_000,)
    """Training lengths; one table each."""
    profiled: int = Field(200, ge=0, le=100_000)
    """Iterations of each recipe, continued from its first trained model, whose stages are timed. 0 = none."""
    visits: int = Field(0, ge=0, le=1_000)
    """Stops of each training at which its held-out quality is measured, for the time to quality. 0 = none."""
    workers: int = Field(4, ge=0, le=64)
    """Processes that decode images for the plain recipe, as in gsplat's example. 0 = its own process decodes."""

    @property
    def recipes(self) -> tuple[str, ...]:
        """All recipes in the order of the tables: the plain ones, and 'ours', the method."""
        return (*self.baselines, OURS)
