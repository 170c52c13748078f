"""Speed files (docs/speed.md): which trainings are timed."""

from typing import Annotated

from pydantic import AfterValidator, Field

from benchmarks.files import BenchmarkFile


def _no_duplicates(lengths: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(lengths)) != len(lengths):
        raise ValueError("it names a length twice")
    return lengths


class SpeedFile(BenchmarkFile):
    method: str = "vanilla"
    """The method of the config that is compared with the plain recipe."""
    iterations: Annotated[
        tuple[Annotated[int, Field(ge=1, le=1_000_000)], ...], Field(min_length=1), AfterValidator(_no_duplicates)
    ] = (30_000,)
    """Training lengths; one table each."""
    profiled: int = Field(200, ge=0, le=100_000)
    """Iterations of each recipe, continued from its first trained model, whose stages are timed. 0 = none."""
    workers: int = Field(4, ge=0, le=64)
    """Processes that decode images for the plain recipe, as in gsplat's example. 0 = its own process decodes."""
