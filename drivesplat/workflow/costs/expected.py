"""What a job may be expected to cost, before it runs: as its like did here, else as on a machine that is known."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.train import MOVING_PARTS
from drivesplat.settings.world import WorldSettings
from drivesplat.workflow.costs.measured import TRAIN, WORLD, Cost, Job

KNOWN_MACHINE = "two processor cores, films as the demo's; trainings on one NVIDIA H200 at 640x360"
SECONDS = {
    "demo_world": 36.0, "lpips_backbone": 1.0, "extract": 1.5, "own_car": 1.0, "refine_poses": 62.0, "lidar_seed": 3.0,
    "parser": 0.5, "masks": 6.0, "actors": 3.0, "lidar_depth": 3.0, "free_space": 3.0, "evaluate": 5.5, "tracks": 2.0,
    "scene_metrics": 0.5, "film": 12.5, "film_parts": 9.0, "edit": 11.0, "ghost_panel": 3.5, "remove_actor": 2.5,
    "export": 2.0, "export_usd": 2.0, "export_viewer": 2.0, "ablation": 1.0, "gap_report": 1.0,
}  # fmt: skip
"""Seconds of stages on KNOWN_MACHINE: of a scene's own with one camera of nuScenes' size, of what a model is rendered
for with the demo's."""
OTHERS = 10.0
"""Seconds of a stage that is not among them."""
START_SECONDS = 4.0
"""Of every training: images are read, the model is made, files are written."""
ITERATIONS_PER_SECOND = {
    ("gpu", False): 730.0, ("gpu", True): 400.0, ("cpu", False): 18.5, ("cpu", True): 14.0
}  # fmt: skip
"""By device, and by whether a method has parts that move; on CPUs those of the demo."""


@dataclass(frozen=True)
class Expected:
    """Seconds of a job, and the jobs measured here that say so; none where it is rough."""

    seconds: float
    measured: frozenset[Job]


class Expectations:
    """What jobs of a `config` may cost where others have cost `costs`."""

    def __init__(self, config: Config, costs: Sequence[Cost]):
        self.config = config
        self._costs: dict[tuple[str, str], list[Cost]] = {}
        for cost in costs:
            self._costs.setdefault((cost.job.stage, self.dataset(cost.job.scene)), []).append(cost)
        self._iterations: dict[tuple[str, str], int] = {}

    def of(self, job: Job) -> Expected:
        """As the job itself cost when it ran before; else the median of this stage and method on other scenes of the
        dataset; else of this stage; else as on the known machine. A training's seconds go with its iterations."""
        peers = self._costs.get((job.stage, self.dataset(job.scene)), [])
        alike: list[Callable[[Cost], bool]] = [
            lambda cost: cost.job == job,
            lambda cost: cost.job.method == job.method,
            lambda cost: job.stage != TRAIN or self._moves(cost.job.method) == self._moves(job.method),
        ]
        for like in alike:
            found = {c.job: seconds for c in peers if like(c) and (seconds := self._scaled(c, job)) is not None}
            if found:
                return Expected(statistics.median(found.values()), frozenset(found))
        return Expected(self._rough(job), frozenset())

    def peers(self, scene: str) -> list[str]:
        """The other scenes of a scene's dataset."""
        return [other for other in self.config.scenes if other != scene and self.dataset(other) == self.dataset(scene)]

    def dataset(self, scene: str) -> str:
        """The dataset of a scene, empty for jobs of no scene; a scene that is not configured any more has its own."""
        return self.config.dataset_of(scene) if scene in self.config.scenes else f"?{scene}" if scene else ""

    def _scaled(self, cost: Cost, job: Job) -> float | None:
        if job.stage == WORLD and cost.job != job:
            made, wanted = self._world(cost.job), self._world(job)
            return cost.seconds * rays_of(wanted) / rays_of(made) if made and wanted else None
        if job.stage != TRAIN:
            return cost.seconds
        return cost.seconds * self._planned_iterations(job) / cost.iterations if cost.iterations else None

    def _rough(self, job: Job) -> float:
        if job.stage == WORLD:
            return SECONDS[WORLD] * rays_of(self._world(job) or WorldSettings()) / rays_of(WorldSettings())
        if job.stage != TRAIN:
            return SECONDS.get(job.stage, OTHERS)
        kind = for_scene(self.config, job.scene).device.kind
        synthetic = self.config.datasets[self.config.dataset_of(job.scene)].world is not None
        where = "cpu" if kind == "cpu" or (kind == "auto" and synthetic) else "gpu"
        return START_SECONDS + self._planned_iterations(job) / ITERATIONS_PER_SECOND[where, self._moves(job.method)]

    def _world(self, job: Job) -> WorldSettings | None:
        """The synthetic world that a job makes; None where it is not configured any more."""
        dataset = self.config.datasets.get(job.film)
        return dataset.world if dataset is not None else None

    def _planned_iterations(self, job: Job) -> int:
        key = job.scene, job.method
        if key not in self._iterations:
            self._iterations[key] = for_scene(self.config, *key).train.iterations
        return self._iterations[key]

    def _moves(self, method: str) -> bool:
        known = self.config.all_methods
        return method in known and bool(set(known[method].parts) & MOVING_PARTS)


def images_of(world: WorldSettings) -> int:
    """How many images a synthetic world has: six a key frame, two more of truth, and five between two key frames of
    each camera that also records there."""
    between = sum(channel.startswith("CAM") for channel in world.sweeps)
    return 8 * world.key_frames + 5 * (world.key_frames - 1) * between


def rays_of(world: WorldSettings) -> int:
    """How many rays a synthetic world is cast by, about, in rays of one pixel."""
    return images_of(world) * world.width**2 * world.samples_per_pixel


@dataclass(frozen=True)
class Work:
    """What is left of a job: seconds, on so many threads, with a GPU or without."""

    job: Job
    seconds: float
    threads: int
    on_gpu: bool


def wall_seconds(work: Iterable[Work], cores: int, gpus: int) -> float:
    """How long `work` takes at least on a machine: its cores are not idle, each GPU has one job, and of a scene the
    training of a method waits for the scene's stages. Never far off where there is more work than machine."""
    there = list(work)
    busy = sum(one.seconds * min(one.threads, cores) for one in there) / max(1, cores)
    on_gpus = sum(one.seconds for one in there if one.on_gpu) / max(1, gpus)
    return max(busy, on_gpus, _longest_chain(there))


def _longest_chain(work: Sequence[Work]) -> float:
    """Of any scene its own stages, then the training and the longest further job of its longest method."""
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
