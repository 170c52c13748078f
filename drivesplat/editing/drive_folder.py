"""The stage `drive_folder`: writes a rendered drive as a dataset: images, poses, calibration and boxes."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from drivesplat.editing.assets.asset import NO_INSERTS, Inserts
from drivesplat.editing.drive_labels import labelled
from drivesplat.editing.film import edited_frames
from drivesplat.editing.placed_model import placed_models
from drivesplat.editing.render_plan import ImageRenderPlan, image_render_plan
from drivesplat.io.jpeg import encoded_jpeg
from drivesplat.io.prefetch import prefetch_items
from drivesplat.io.storage import Provenance, atomic_write, write_json
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.readers.drive.write import write_record
from drivesplat.readers.nuscenes.write import write_nuscenes
from drivesplat.readers.truth import depth_units, numbered
from drivesplat.rendering.frames import film_frames
from drivesplat.scene.images import write_png
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import last_training_timestamp
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.export import DriveJob, DriveLabel

TABLES, VERSION = "nuscenes", "v1.0-rendered"
"""The folder of the nuScenes dataset in a drive folder, and the name of its version."""


def write_rendered_drive(
    scene: Scene,
    checkpoint: TrainedCheckpoint,
    job: DriveJob,
    device_settings: DeviceSettings,
    path: Path,
    source: dict[str, str],
    provenance: Provenance,
    inserts: Inserts = NO_INSERTS,
) -> None:
    """Writes the drive folder of `path`, its drive.json: images/, and the same drive as nuScenes tables in nuscenes/.

    `source` names the `scene`, the `method`, and the `edit` or the `trajectory` in the record that marks the drive as
    rendered; the scene of the tables is called by scene and edit or trajectory. The edit inserts `inserts`.
    Raises what `image_render_plan` raises; DeviceError; ResultError where a rendering contains NaN or Inf, or the disk
    is full."""
    folder, what = path.parent, " ".join(f"{key} {value}" for key, value in source.items())
    _remove(folder)
    model, device = open_model(checkpoint, device_settings)
    drive = image_render_plan(scene, model, job, folder, what, inserts)
    try:
        with explain_out_of_memory(lambda: len(model)):
            views = drive.views(device)
            if drive.edited:
                pictures = edited_frames(drive.objects.model, views, drive.objects.actors, drive.seconds)
            else:
                model.precompute(drive.seconds.tolist())
                pictures = film_frames(model, ((view, None) for view in views))
            for frame, pixels in zip(drive.scene.frames, prefetch_items(pictures), strict=True):
                with atomic_write(Path(frame.image_path)) as file:
                    file.write(encoded_jpeg(pixels))
            instances = _write_label_images(folder, drive, job.labels, device)
            trained_until = last_training_timestamp(scene, job.eval_camera, job.holdout)
            drive, labels = labelled(scene, drive, trained_until, device, what)
        marked = replace(
            drive.scene,
            name=f"{source['scene']}_{source.get('edit') or source.get('trajectory')}",
            description=f"Rendered by drivesplat, not recorded ({what}). {drive.scene.description}".strip(),
            provenance=provenance,
        )
        steps = None if job.edit is None else job.edit.model_dump(mode="json", exclude_none=True)["steps"]
        rendered: dict[str, Any] = {
            **source, "steps": steps, "trained_until": labels.trained_until, "shown_by": labels.shown_by,
            **({"instances": instances} if "instances" in job.labels else {}),
        }  # fmt: skip
        log = {"logfile": "rendered-by-drivesplat", "vehicle": "rendered", "date_captured": "", "location": what}
        write_nuscenes(marked, labels, folder / TABLES, VERSION, log)
        write_json(folder / TABLES / "provenance.json", {"rendered": rendered, "provenance": provenance})
        write_record(path, replace(marked, tracks=drive.tracks), {**rendered, "provenance": provenance})
    except BaseException:
        _remove(folder)
        raise


@torch.no_grad()
def _write_label_images(
    folder: Path, drive: ImageRenderPlan, labels: Sequence[DriveLabel], device: torch.device
) -> dict[str, int]:
    """Writes the depth and the objects of every image as 16-bit images, as `labels` say; returns the numbers of objects
    in these by id."""
    actors = drive.objects.actors
    numbers = {actor.id: number for number, actor in enumerate(actors, start=1)}
    if not labels:
        return numbers
    placed_at = placed_models(drive.objects.model, actors, drive.seconds)
    for frame, view, placed in zip(drive.scene.frames, drive.views(device), placed_at, strict=True):
        image = Path(frame.image_path)
        named = {label: folder / label / image.parent.name / f"{image.stem}.png" for label in labels}
        for path in named.values():
            path.parent.mkdir(parents=True, exist_ok=True)
        if "depth" in named:
            write_png(named["depth"], depth_units(placed.surface_depth(view).cpu().numpy()))
        if "instances" in named:
            present = [actor for actor in actors if actor.present(np.array([view.time]))[0]]
            shown = placed.objects_in(view).cpu().numpy()
            write_png(named["instances"], numbered(shown, [numbers[actor.id] for actor in present]))
    return numbers


def _remove(folder: Path) -> None:
    """Removes the images and tables of an earlier or a failed run."""
    for part in (folder / "images", folder / TABLES, *(folder / label for label in get_args(DriveLabel))):
        if part.exists():
            shutil.rmtree(part)
