"""Trainings that are timed: what a file for `python -m benchmarks.speed` may hold (docs/speed.md)."""

from typing import Annotated, Any

from pydantic import AfterValidator, Field, field_validator

from drivesplat.settings import Settings
from drivesplat.settings.method import Seeds
from drivesplat.settings.names import require_text


def _each_once(lengths: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(lengths)) != len(lengths):
        raise ValueError("it names a length twice")
    return lengths


class SpeedFile(Settings):
    base: tuple[str, ...] = ()
    """Config files laid over config.yaml, each over those before it, as with Snakemake's --configfile."""
    config: dict[str, Any] = Field(default_factory=dict)
    """Settings of the scene and of the method, as a tree, laid over these; they hold over what a dataset sets for
    itself, too."""
    scene: str
    """The scene that is trained on; quoted."""
    method: str = "vanilla"
    """The method of the config that is held to the plain recipe."""
    iterations: Annotated[
        tuple[Annotated[int, Field(ge=1, le=1_000_000)], ...], Field(min_length=1), AfterValidator(_each_once)
    ] = (30_000,)
    """How long the trainings are; a table each."""
    seeds: Seeds = (0, 1, 2)
    """Random seeds: both recipes are trained with each."""
    profiled: int = Field(200, ge=0, le=100_000)
    """So many iterations of each recipe, from where its first training ended, are timed stage by stage. 0 = none."""
    workers: int = Field(4, ge=0, le=64)
    """Processes that decode images for the plain recipe; gsplat's example has 4. 0 = its own process does."""

    @field_validator("scene", mode="before")
    @classmethod
    def _is_quoted(cls, value: Any) -> Any:
        require_text(value)
        return value
