"""The expected seconds of a job: the median of measured jobs like it, None where there are none."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.costs.measured import TRAIN, WORLD, Cost, JobId


@dataclass(frozen=True)
class Expected:
    """Seconds of a job and the measured jobs they come from; None where nothing like it has been measured."""

    seconds: float | None
    measured: frozenset[JobId] = frozenset()


class Expectations:
    """The expected costs of jobs of a `config`, given measured `costs`."""

    def __init__(self, config: Config, costs: Sequence[Cost]):
        self.config = config
        self._costs: dict[tuple[str, str], list[Cost]] = {}
        for cost in costs:
            self._costs.setdefault(self._kind(cost.job), []).append(cost)

    def of(self, job: JobId) -> Expected:
        """The cost of the job itself where it ran before; else the median of its stage and method on other scenes of
        the dataset; else of its stage. A training's seconds are scaled with its iterations."""
        peers = self._costs.get(self._kind(job), [])
        alike: list[Callable[[Cost], bool]] = [
            lambda cost: cost.job == job,
            lambda cost: cost.job.method == job.method,
            lambda cost: job.stage != TRAIN or self._moves(cost.job.method) == self._moves(job.method),
        ]
        for like in alike:
            found = {c.job: seconds for c in peers if like(c) and (seconds := self._scaled(c, job)) is not None}
            if found:
                return Expected(statistics.median(found.values()), frozenset(found))
        return Expected(None)

    def peers(self, scene: str) -> list[str]:
        """The other scenes of a scene's dataset."""
        return [
            other for other in self.config.scenes if other != scene and self._dataset(other) == self._dataset(scene)
        ]

    def _kind(self, job: JobId) -> tuple[str, str]:
        """Jobs of one kind may tell each other's cost; a synthetic world tells that of no other."""
        return job.stage, job.film if job.stage == WORLD else self._dataset(job.scene)

    def _dataset(self, scene: str) -> str:
        """A scene's dataset, empty for jobs of no scene; a scene that is no longer configured has one of its own."""
        return self.config.dataset_names.get(scene, f"?{scene}" if scene else "")

    def _scaled(self, cost: Cost, job: JobId) -> float | None:
        if job.stage != TRAIN:
            return cost.seconds
        iterations = for_scene(self.config, job.scene, job.method).train.iterations
        return cost.seconds * iterations / cost.iterations if cost.iterations else None

    def _moves(self, method: str) -> bool:
        known = self.config.all_methods
        return method in known and bool(known[method].moving_parts)


@dataclass(frozen=True)
class Work:
    """The remaining seconds of a job, on some threads, with a GPU or without."""

    job: JobId
    seconds: float
    threads: int
    on_gpu: bool


def wall_seconds(work: Iterable[Work], cores: int, gpus: int) -> float:
    """A lower bound of the time that `work` takes: cores are never idle, each GPU has one job, and a method's training
    waits for its scene's stages. Close where there is more work than machine."""
    jobs = list(work)
    busy = sum(one.seconds * min(one.threads, cores) for one in jobs) / max(1, cores)
    on_gpus = sum(one.seconds for one in jobs if one.on_gpu) / max(1, gpus)
    return max(busy, on_gpus, _longest_chain(jobs))


def _longest_chain(work: Sequence[Work]) -> float:
    """Over scenes: the scene's own stages, then the training and the longest further job of its longest method."""
    scenes: dict[str, dict[str, list[Work]]] = {}
    for one in work:
        scenes.setdefault(one.job.scene, {}).setdefault(one.job.method, []).append(one)
    chains = [0.0]
    for methods in scenes.values():
        own = sum(one.seconds for one in methods.pop("", []))
        chains.append(own + max(map(_method_chain, methods.values()), default=0.0))
    return max(chains)


def _method_chain(work: Sequence[Work]) -> float:
    others = (one.seconds for one in work if one.job.stage != TRAIN)
    return sum(one.seconds for one in work if one.job.stage == TRAIN) + max(others, default=0.0)
