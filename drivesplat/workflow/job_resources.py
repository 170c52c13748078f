"""What the jobs of a config take of the machine: devices and threads."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from drivesplat.io.storage import canonical_json
from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.gpus import any_gpu
from drivesplat.workflow.outputs import Outputs

MAX_MASK_THREADS = 8
"""Maximum number of threads of the masks of a scene."""


class JobResources(Outputs):
    """The devices and threads of a validated config's jobs; arguments as in `Outputs`."""

    def __init__(self, config: Config, scripts: Path, prefix: str = "", is_main: bool = True):
        super().__init__(config, scripts, prefix, is_main)
        self._devices: dict[str, tuple[str, int]] = {}

    def device(self, wildcards: Any) -> str:
        """The device settings of a scene's jobs as canonical JSON. A resource of the rules, not a param: moving to
        another machine reruns nothing."""
        return self._device(wildcards.scene)[0]

    def gpus(self, wildcards: Any) -> int:
        """The number of GPUs that a training or rendering of a scene takes: 1, or 0 on the CPU of this machine."""
        return self._device(wildcards.scene)[1]

    def threads(self, on_gpu: int) -> Callable[[Any], int]:
        """The threads of such a job: `on_gpu` with a GPU, otherwise half of the processors, since two jobs in parallel
        finish sooner than two in sequence on all processors."""
        on_cpu = max(1, len(os.sched_getaffinity(0)) // 2)
        return lambda wildcards: on_gpu if self.gpus(wildcards) else on_cpu

    def mask_threads(self, wildcards: Any) -> int:
        """The threads of a scene's masks: two for each camera, at most `MAX_MASK_THREADS`. Masks of a front camera thus
        start beside trainings of other scenes on few free processors."""
        return min(MAX_MASK_THREADS, max(1, 2 * len(for_scene(self.config, wildcards.scene).cameras)))

    def _device(self, scene: str) -> tuple[str, int]:
        """The device of a scene's jobs as canonical JSON, and how many GPUs each takes."""
        name = self.config.dataset_of(scene)
        if name not in self._devices:
            device = for_scene(self.config, scene).device.model_dump(mode="json")
            if self.config.datasets[name].world is not None and device["kind"] == "auto":
                device["kind"] = "any"
            on_gpu = device["kind"] != "cpu" and (device["kind"] != "any" or any_gpu())
            self._devices[name] = canonical_json(device), int(on_gpu)
        return self._devices[name]
