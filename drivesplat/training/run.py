"""A training from a parser record to its files: checkpoint.pt and train.json."""

import dataclasses
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.device import choose_device, telling_out_of_memory
from drivesplat.masks import read_sky_mask
from drivesplat.model.build import build_model, gaussian_cap, rebuild_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.parser import image_size
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.train import TrainJob
from drivesplat.storage import canonical_json, sha256_text, unreadable, write_json
from drivesplat.training import checkpoint
from drivesplat.training.train import Workspace, train
from drivesplat.training.views import TrainingView, load_views


@dataclass(frozen=True)
class TrainingFiles:
    """What a training writes (`checkpoint`, `summary`) and the folder of `masks` it reads."""

    checkpoint: Path
    summary: Path
    masks: Path

    @property
    def resume(self) -> Path:
        """What a killed training goes on from; undeclared, so that Snakemake leaves it alone."""
        return self.checkpoint.parent / "resume"


def run_training(
    parser: dict[str, Any],
    job: TrainJob,
    device_settings: DeviceSettings,
    files: TrainingFiles,
    provenance: dict[str, Any],
    label: str,
) -> None:
    """Trains and writes both files, or raises and leaves neither; the resume state outlives a failure."""
    with checkpoint.sole_trainer(files.resume):
        device = choose_device(device_settings)
        sky_masks = sky_masks_of(parser, files.masks) if job.sky != "none" else None
        with telling_out_of_memory(lambda: 0):
            views = load_views(parser, sky_masks, device)
        settings = job.train.model_copy(update={"cap_max": gaussian_cap(parser, job.train)})
        model = build_model(parser, job.parts, job.sky, settings, mean_sky_color(views))
        fingerprint = sha256_text(
            canonical_json([provenance[k] for k in ("settings_sha256", "code_sha256", "inputs_sha256")])
        )
        workspace = Workspace(files.resume, files.checkpoint.parent / "tensorboard", fingerprint, label)
        summary = train(model, views, settings, job.random_seed, parser["scene_scale"], device, workspace)
        content = {
            "model": {key: value.detach().cpu() for key, value in model.state_dict().items()},
            "job": job.model_dump_json(),
            "scene_scale": parser["scene_scale"],
            "provenance": provenance,
        }
        checkpoint.save(files.checkpoint, content)
        write_json(files.summary, {**dataclasses.asdict(summary), "provenance": provenance})
    shutil.rmtree(files.resume)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Reads `checkpoint.pt`. Raises ResultError where it is not one, or holds anything but tensors and plain data."""
    content = checkpoint.load(Path(path), rule="train")
    if not {"model", "job", "scene_scale", "provenance"} <= content.keys():
        raise unreadable(path, "train", "not a checkpoint of a finished training")
    return content


def trained_model(content: dict[str, Any]) -> tuple[SplatModel, TrainJob]:
    """The model of a checkpoint's content, on the CPU, and the settings it was trained with."""
    job = TrainJob.model_validate_json(content["job"])
    return rebuild_model(content["model"], job.parts, job.sky, job.train, content["scene_scale"]), job


def sky_masks_of(parser: dict[str, Any], masks: Path) -> dict[str, np.ndarray]:
    """The sky (h, w) bool of every training image, by image path."""
    found = {}
    for i in parser["splits"]["train"]:
        camera = parser["camera_names"][parser["camera_indices"][i]]
        size = image_size(parser, i)
        found[parser["image_paths"][i]] = read_sky_mask(masks, camera, int(parser["timestamps"][i]), size)
    return found


def mean_sky_color(views: list[TrainingView]) -> np.ndarray:
    """The mean colour (3,) in [0, 1] of the sky pixels of the training images; light grey where there are none."""
    sums, count = np.zeros(3), 0
    for view in views:
        if view.sky is not None:
            sums += (view.target() * view.sky[..., None]).sum(dim=(0, 1)).cpu().numpy()
            count += int(view.sky.sum())
    return sums / count if count else np.full(3, 0.75)
