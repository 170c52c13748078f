"""What there is of a group's recipes once Snakemake has ended: figures that belong to them, or why there are none."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from benchmarks.quality.groups import Group
from benchmarks.quality.runs import Outcome, unexplained
from drivesplat.errors import ResultError
from drivesplat.io.storage import read_json, unreadable
from drivesplat.provenance.record import differences
from drivesplat.settings.method import with_seed

ON_CARDS = ("train", "evaluate")
"""The stages that take a card."""
PROCESSORS = "the processors"
_TIME = r"^(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3}) "
TIME_FORMAT = "%Y-%m-%d %H:%M:%S,%f"
"""How logs tell the time (`drivesplat.workflow.job`)."""
_LINE = re.compile(_TIME, re.MULTILINE)
_CARD = re.compile(_TIME + r"INFO drivesplat\.workflow\.gpus: runs on the GPU \S+ \((\S+)\)$", re.MULTILINE)


@dataclass(frozen=True)
class Result:
    """A recipe trained with a seed: its eval.json, with its path, or why there is none; and whether another job was
    seen to run on the same card, or on the same processors, while it was trained."""

    recipe: str
    seed: int
    path: Path
    evaluation: dict[str, Any] | None = None
    why: str = ""
    shared: bool = False

    @property
    def result(self) -> dict[str, Any] | None:
        """Its figures."""
        return self.evaluation["result"] if self.evaluation else None


@dataclass(frozen=True)
class Occupation:
    """A job on a card, from when it has it to when it ends."""

    card: str
    began: datetime
    ended: datetime

    def meets(self, other: "Occupation") -> bool:
        """Whether both were on one card at one time."""
        return self.card == other.card and self.began < other.ended and other.began < self.ended


def results_of(ended: Sequence[tuple[Group, Outcome]]) -> list[Result]:
    """What there is of every recipe with every seed of groups whose runs of Snakemake have ended, recipe by recipe."""
    found = [
        (group, _result(group, recipe, seed, outcome))
        for group, outcome in ended
        for recipe in group.recipes
        for seed in group.seeds
    ]
    held = {
        (result.recipe, result.seed, stage): span
        for group, result in found
        for stage in ON_CARDS
        if (span := _occupation(group, result, stage)) is not None
    }
    return [dataclasses.replace(result, shared=_shared(result, held)) for _, result in found]


def _result(group: Group, recipe: str, seed: int, outcome: Outcome) -> Result:
    """The result of a recipe with a seed; none where what lies there was made otherwise than the group's plan says: a
    training that failed leaves the figures of an earlier one in place."""
    path, method = group.evaluation(recipe, seed), with_seed(recipe, seed)
    missing = Result(recipe, seed, path, why=outcome.why(method) or unexplained(group, recipe, seed))
    if not path.is_file():
        return missing
    try:
        evaluation = read_json(path, rule="evaluate")
        stale = differences(group.plan.evaluation_stages(group.scene, [method]), evaluation["provenance"]["stages"])
    except ResultError as error:
        return dataclasses.replace(missing, why=str(error))
    except (AttributeError, KeyError, TypeError) as error:
        why = unreadable(path, "evaluate", f"not the figures of a method ({type(error).__name__}: {error})")
        return dataclasses.replace(missing, why=str(why))
    if stale:
        return dataclasses.replace(missing, why=f"{missing.why} (an earlier result does not count: {stale[0]})")
    return Result(recipe, seed, path, evaluation)


def occupation(log: str, on_processors: bool) -> Occupation | None:
    """When a job ran on which card, as its log says; one whose log names none may be known to have run `on_processors`.
    None where it is not known."""
    times, card = [datetime.strptime(time, TIME_FORMAT) for time in _LINE.findall(log)], _CARD.search(log)
    if card:
        return Occupation(card[2], datetime.strptime(card[1], TIME_FORMAT), times[-1])
    return Occupation(PROCESSORS, times[0], times[-1]) if on_processors and times else None


def _occupation(group: Group, result: Result, stage: str) -> Occupation | None:
    """When a stage of a recipe ran on which card; None where that is not known."""
    try:
        log = group.log(result.recipe, result.seed, stage).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None
    return occupation(log, on_processors=result.result is not None and result.result["device"].startswith("cpu"))


def _shared(result: Result, held: Mapping[tuple[str, int, str], Occupation]) -> bool:
    """Whether the training of a result met another's job on its card."""
    own = held.get((result.recipe, result.seed, "train"))
    others = (occupation for key, occupation in held.items() if key[:2] != (result.recipe, result.seed))
    return own is not None and any(own.meets(other) for other in others)
