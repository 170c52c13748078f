"""One training, timed and evaluated: by the plain recipe, or by the function of the rule `train`."""

import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch

from benchmarks.speed.cpu_load import CpuSample, busy_elsewhere
from benchmarks.speed.curves import QualityCurve, held_out_frames
from benchmarks.speed.plain import (
    VARIANTS,
    PlainName,
    PlainRecipe,
    Schedule,
    Variant,
    as_model,
    as_splats,
    init_splats,
    make_sky,
    scene_scale,
)
from benchmarks.speed.plain_images import ImageFiles, files_of_size
from benchmarks.speed.plain_training import CHECKPOINT, fit
from benchmarks.speed.plan import Task
from benchmarks.speed.settings import OURS
from benchmarks.speed.stage_clock import StageClock
from drivesplat.errors import DeviceError
from drivesplat.evaluation.evaluate import protocol
from drivesplat.evaluation.image_metrics import evaluate_groups
from drivesplat.io.checkpoint_file import load
from drivesplat.io.storage import read_json
from drivesplat.machine.device import choose_device, device_name
from drivesplat.model.build import gaussian_cap
from drivesplat.model.checkpoint import read_checkpoint, trained_model
from drivesplat.model.parameters import random_subset
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.provenance.record import provenance
from drivesplat.rasterization import rasterize
from drivesplat.scene.evaluation_data import read_evaluation_data
from drivesplat.scene.masks import read_masks_record
from drivesplat.scene.training_record import read_training_record
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.train import CoarseToFineSettings
from drivesplat.training.loop import TrainingFolders, train
from drivesplat.training.probes import Probes
from drivesplat.training.stage import TrainingFiles, TrainingInputs, prepare, read_inputs, run_training
from drivesplat.training.step import UNTIMED, Clock
from drivesplat.workflow.gpus import hold_gpu

Times = dict[str, Any]
WHOLE_IMAGES = CoarseToFineSettings(quarter_until=0.0, half_until=0.0)
WARM_UP = 20
"""Iterations before stages are timed."""


def run(task: Task) -> dict[str, Any]:
    """Trains and evaluates. Returns `loop`, the seconds of the training loop; `whole`, the seconds from reading
    parser.npz to the written files; `busy_elsewhere`, the mean number of `processors` that other programs kept busy
    (None if unknown); `result`, the metrics per group of held-out frames under `protocol`; and more.

    The rasterizer's kernels and the reduced images, which all recipes need once, are prepared before timing.
    """
    shutil.rmtree(task.folder, ignore_errors=True)
    with held_device(task.device) as device:
        record = read_training_record(task.files.parser)
        paths = files_of_size(record, task.images)
        recording, _ = read_evaluation_data(task.files.scene, task.files.parser, task.files.masks)
        masks, camera = read_masks_record(recording.masks), task.evaluate.eval_camera
        curve = QualityCurve(held_out_frames(recording, camera, device) if task.visits else [])
        visits, before = Probes(task.visits, curve.see), CpuSample.now()
        if task.recipe == OURS:
            times, model = ours(task, device, visits)
        else:
            times, model = plain(task, device, paths, visits)
        elsewhere = busy_elsewhere(before, CpuSample.now())
        groups = evaluate_groups(model.to(device).requires_grad_(False), recording, camera, None, device)
        return {
            "recipe": task.recipe,
            "iterations": task.iterations,
            "seed": task.seed,
            "device": device_name(device),
            "processors": os.cpu_count(),
            "busy_elsewhere": elsewhere,
            "cap_max": gaussian_cap(record, task.train.train),
            **times,
            "whole": times["whole"] - curve.spent,
            "dataset": record.scene.dataset,
            "protocol": protocol(record, masks, task.evaluate),
            "result": groups,
            "curve": curve.points,
        }


def plain(task: Task, device: torch.device, paths: list[str], visits: Probes) -> tuple[Times, SplatModel]:
    """Times of a training by a variant of the plain recipe, and its model. Raises DeviceError for a packed one without
    a GPU."""
    variant = _variant(task)
    if variant.packed and device.type != "cuda":
        raise DeviceError(f"{task.recipe}: gsplat's Adam of visible Gaussians needs a GPU; drop it from baselines")
    began = time.monotonic()
    record = read_training_record(task.files.parser)
    cap = gaussian_cap(record, task.train.train)
    kept = random_subset(len(record.points), cap)
    splats = init_splats(record.points[kept], record.points_rgb[kept], task.seed).to(device)
    recipe, sky = PlainRecipe(Schedule.of(task.iterations), cap, task.seed, task.workers, variant), _sky(task, device)
    scale = scene_scale(record)
    summary = fit(splats, ImageFiles(record, paths), scale, recipe, task.folder, sky=sky, visits=visits)
    costs = {key: getattr(summary, key) for key in ("gaussians", "peak_gpu_memory_gb", "ssim")}
    times = {"loop": summary.seconds, "whole": summary.ended - began, **costs}
    return times, as_model({name: value.detach() for name, value in splats.items()}, scale, sky)


def _variant(task: Task) -> Variant:
    return VARIANTS[cast(PlainName, task.recipe)]


def _sky(task: Task, device: torch.device) -> CubemapSky | None:
    """The untrained sky of a plain task."""
    sky = make_sky(_variant(task), task.train.train)
    return None if sky is None else sky.to(device)


def ours(task: Task, device: torch.device, visits: Probes) -> tuple[Times, SplatModel]:
    """Times of a training by the function of the rule `train`, and its model. Two iterations before it load its
    kernels."""
    _continue(task, device, 2)
    began = time.monotonic()
    inputs, upstream = _inputs(task)
    settings = json.loads(task.train.model_dump_json())
    made = provenance(task.stage, settings, task.code, upstream, {})
    files = training_files(task)
    run_training(inputs, task.train, task.device, files, made, task.label, visits)
    whole, summary = time.monotonic() - began, read_json(files.summary, rule="train")
    model = trained_model(read_checkpoint(files.checkpoint))
    costs = {key: summary[key] for key in ("gaussians", "peak_gpu_memory_gb")}
    return {"loop": summary["seconds"], "whole": whole, **costs}, model


def training_files(task: Task) -> TrainingFiles:
    """The output files of a training of ours."""
    return TrainingFiles(task.folder / "checkpoint.npz", task.folder / "train.json")


def profile(task: Task, iterations: int) -> dict[str, dict[str, float]]:
    """`device_ms` and `host_ms` of each stage (`benchmarks.speed.stage_clock`) in milliseconds per iteration, over
    iterations that continue a task's training. The continued model is discarded."""
    profiled = _profile_ours if task.recipe == OURS else _profile_plain
    with held_device(task.device) as device:
        clock = StageClock(device, WARM_UP)
        profiled(task, device, WARM_UP + iterations, clock)
        return {name: asdict(share) for name, share in clock.shares().items()}


def _profile_plain(task: Task, device: torch.device, iterations: int, clock: StageClock) -> None:
    record = read_training_record(task.files.parser)
    trained, sky = load(task.folder / CHECKPOINT, rule="train"), _sky(task, device)
    splats = as_splats(trained["splats"]).to(device)
    if sky is not None:
        sky.load_state_dict(trained["sky"])
    cap = gaussian_cap(record, task.train.train)
    recipe = PlainRecipe(Schedule.continued(iterations), cap, task.seed, task.workers, _variant(task))
    images = ImageFiles(record, files_of_size(record, task.images))
    fit(splats, images, scene_scale(record), recipe, _profile_folder(task), clock, sky)
    shutil.rmtree(_profile_folder(task))


def _profile_ours(task: Task, device: torch.device, iterations: int, clock: StageClock) -> None:
    model = trained_model(read_checkpoint(training_files(task).checkpoint))
    _continue(task, device, iterations, model, clock)


def _continue(
    task: Task, device: torch.device, iterations: int, model: SplatModel | None = None, clock: Clock = UNTIMED
) -> None:
    """Trains a model (None: a new one) with all degrees of harmonics, full-size images and densification."""
    inputs, _ = _inputs(task)
    begun = prepare(inputs, task.train, device)
    continued = {"iterations": iterations, "sh_every": 0.0, "refine_start": 0.0, "refine_stop": 1.0}
    settings = begun.settings.model_copy(update={**continued, "coarse_to_fine": WHOLE_IMAGES})
    folders = TrainingFolders(_profile_folder(task) / "resume", _profile_folder(task) / "tensorboard", "", task.label)
    trained = begun.model if model is None else model
    train(trained, begun.views, settings, task.seed, device, folders, begun.road, clock, scans=begun.scans)
    shutil.rmtree(_profile_folder(task))


def _inputs(task: Task) -> tuple[TrainingInputs, list[dict[str, Any]]]:
    files = task.files
    return read_inputs(files.parser, [files.masks], files.actors, files.lidar_depth, files.scans)


def _profile_folder(task: Task) -> Path:
    return task.folder / "profile"


@contextmanager
def held_device(settings: DeviceSettings) -> Iterator[torch.device]:
    """The device that the settings choose, with no other job of this workflow on it and with its kernels loaded."""
    lock = hold_gpu(1) if settings.kind != "cpu" else None
    try:
        device = choose_device(settings)
        load_kernels(device)
        yield device
    finally:
        if lock is not None:
            lock.close()


def load_kernels(device: torch.device) -> None:
    """Loads the kernels of the rasterizer and the sky and, on a GPU, torch's CUDA context: no timing includes them."""
    means = torch.tensor([[0.0, 0.0, 2.0]] * 8, device=device, requires_grad=True)
    quats, scales = torch.ones(8, 4, device=device), torch.full((8, 3), 0.1, device=device)
    opacities, coefficients = torch.full((8,), 0.5, device=device), torch.zeros(8, 16, 3, device=device)
    intrinsics = torch.tensor([[[16.0, 0.0, 16.0], [0.0, 16.0, 16.0], [0.0, 0.0, 1.0]]], device=device)
    cameras = torch.eye(4, device=device)[None], intrinsics, 32, 32
    rendering = rasterize(means, quats, scales, opacities, coefficients, *cameras, sh_degree=3)
    sky = CubemapSky(8, torch.full((3,), 0.5), 1e-3).to(device)
    view = View(intrinsics[0], cameras[0][0], *cameras[2:], time=0.0)
    sky.behind(rendering.image[0], rendering.alpha[0], view).sum().backward()
