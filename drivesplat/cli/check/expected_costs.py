"""What the methods of a recording cost on this machine: time, memory and disk."""

import os
from collections.abc import Iterator
from pathlib import Path

from drivesplat.cli.check.chosen import ChosenScene
from drivesplat.readers.datasets import layout, unpacker
from drivesplat.readers.outline import Outline
from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.costs.estimate import Expectations, Machine, PlannedJob, estimate, in_one_line
from drivesplat.workflow.costs.measured import JobId, read_costs
from drivesplat.workflow.gpus import any_gpu, visible_gpus
from drivesplat.workflow.recording_faults import image_gb
from drivesplat.workflow.stages import TRAIN, stages_of_metrics, track_stages, training_inputs

BASE_GB, GB_PER_MILLION = 1.5, 1.2
"""GPU memory of a training of `street` without its images: in all, and for each million Gaussians (docs/measured.md,
presets)."""
BYTES_PER_GAUSSIAN = 400
"""Of a method's checkpoint and exported files, about."""


def expected_costs(chosen: ChosenScene, config: Config, methods: list[str], outline: Outline) -> Iterator[str]:
    """Sentences about the cost of metrics.json for some methods of a config, on this machine."""
    results, on_gpu, name = Path(config.results_dir), any_gpu(), chosen.name
    cores = len(os.sched_getaffinity(0))
    jobs = list(_planned(config, name, methods, on_gpu, max(1, cores // 2)))
    found = estimate(jobs, Expectations(config, read_costs(results)[0]), Machine(cores, visible_gpus()), results)
    iterations = sorted({for_scene(config, name, method).train.iterations for method in methods})
    many = " or ".join(map(str, iterations))
    yield f"metrics of {', '.join(methods)}, with {many} iterations of training: {in_one_line(found)}"
    config.outlines[name] = outline
    size = image_gb(config, name) or 0.0
    gaussians = max(for_scene(config, name, method).train.cap_max for method in methods) * 1e-6
    kind = "GPU memory" if on_gpu else "main memory, without a GPU"
    yield (
        f"a training takes about {BASE_GB + GB_PER_MILLION * gaussians + size:.1f} GB of {kind}, of which its images "
        f"take {size:.1f} GB; images.width and train.cap_max lower it"
    )
    written = _unpacked_bytes(chosen) + len(methods) * gaussians * 1e6 * BYTES_PER_GAUSSIAN
    yield f"results take very roughly {written * 1e-9:.1f} GB at most in {results}/"


def _planned(config: Config, name: str, methods: list[str], on_gpu: bool, threads: int) -> Iterator[PlannedJob]:
    """The jobs behind a scene's metrics.json."""
    of_scene, of_method = stages_of_metrics(config, name)
    more = [s for m in methods for s in (*training_inputs(config, name, m), *track_stages(config, name, m))]
    for stage in dict.fromkeys((*of_scene, *more)):
        yield PlannedJob(JobId(stage, name), 1, False)
    for method in methods:
        for stage in of_method:
            yield PlannedJob(JobId(stage, name, method), threads, on_gpu and stage == TRAIN)


def _unpacked_bytes(chosen: ChosenScene) -> float:
    """Bytes of the images and sweeps that a reader writes as files of their own: those of its recording, about."""
    if unpacker(chosen.reader) is None:
        return 0.0
    files = layout(chosen.reader).table_files(chosen.root, chosen.version, chosen.name)
    folders = {file if file.is_file() and file.suffix != "" else file.parent for file in files}
    every = (file for place in folders for file in ([place] if place.is_file() else place.rglob("*")))
    return float(sum(file.stat().st_size for file in every if file.is_file()))
