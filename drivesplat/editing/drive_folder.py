"""The stage `drive_folder`: a drive that nobody recorded as a dataset: images, poses, calibration and boxes."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from drivesplat.editing.rendered_drive import RenderedDrive, rendered_drive
from drivesplat.io.prefetch import prefetch_items
from drivesplat.io.storage import Provenance, atomic_write, write_json
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.readers.drive.write import write_record
from drivesplat.readers.nuscenes.write import write_nuscenes
from drivesplat.rendering.captured_frames import FrameInput
from drivesplat.rendering.frames import film_frames
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import training_images
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.export import DriveJob

TABLES, VERSION = "nuscenes", "v1.0-rendered"
"""The folder of the nuScenes dataset in a drive folder, and the name of its version."""
QUALITY = 95
"""JPEG quality of the images, with colours at full resolution."""


def write_rendered_drive(
    scene: Scene,
    checkpoint: TrainedCheckpoint,
    job: DriveJob,
    device_settings: DeviceSettings,
    path: Path,
    source: dict[str, str],
    provenance: Provenance,
) -> None:
    """Writes the drive folder of `path`, its drive.json: images/, and the same drive as nuScenes tables in nuscenes/.

    `source` names the `scene`, the `method`, and the `edit` or the `trajectory` in the record that marks the drive as
    rendered; the scene of the tables is called by scene and edit or trajectory. Raises what `rendered_drive` raises;
    DeviceError; ResultError where a rendering contains NaN or Inf, or the disk is full.
    """
    folder, what = path.parent, " ".join(f"{key} {value}" for key, value in source.items())
    for earlier in ("images", TABLES):
        shutil.rmtree(folder / earlier, ignore_errors=True)
    model, device = open_model(checkpoint, device_settings)
    drive = rendered_drive(scene, model, job, folder, what)
    inputs = _inputs(model, drive, drive.views(device, model.exposure is not None))
    with explain_out_of_memory(lambda: len(model)):
        for frame, pixels in zip(drive.scene.frames, prefetch_items(film_frames(model, inputs)), strict=True):
            _write_jpeg(Path(frame.image_path), pixels)
    marked = replace(
        drive.scene,
        name=f"{source['scene']}_{source.get('edit') or source.get('trajectory')}",
        description=f"Rendered by drivesplat, not recorded ({what}). {scene.description}".strip(),
        provenance=provenance,
    )
    steps = None if job.edit is None else job.edit.model_dump(mode="json", exclude_none=True)["steps"]
    rendered: dict[str, Any] = {**source, "steps": steps, "trained_until": _trained_until(scene, job)}
    log = {"logfile": "rendered-by-drivesplat", "vehicle": "rendered", "date_captured": "", "location": what}
    write_nuscenes(marked, folder / TABLES, VERSION, log)
    write_json(folder / TABLES / "provenance.json", {"rendered": rendered, "provenance": provenance})
    write_record(path, replace(marked, tracks=drive.tracks), {**rendered, "provenance": provenance})


def _inputs(model: SplatModel, drive: RenderedDrive, views: Iterator[View]) -> Iterator[FrameInput]:
    """Each view with the Gaussians that it shows: None for those of the model at its time."""
    placements = drive.placements()
    if placements is None:
        model.precompute(drive.seconds.tolist())
        yield from ((view, None) for view in views)
        return
    for view, actors in zip(views, placements, strict=True):
        yield view, model.gaussians_with_placements(view.time, actors)


def _trained_until(scene: Scene, job: DriveJob) -> int | None:
    """The time of the last training image of the evaluated camera in microseconds; None if there is none."""
    frames = (scene.frames[i] for i in training_images(scene, job.holdout))
    return max((frame.timestamp for frame in frames if frame.camera == job.eval_camera), default=None)


def _write_jpeg(path: Path, pixels: np.ndarray) -> None:
    with atomic_write(path) as file:
        Image.fromarray(pixels).save(file, format="JPEG", quality=QUALITY, subsampling=0)
