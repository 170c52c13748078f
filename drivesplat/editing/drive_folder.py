"""The stage `drive_folder`: writes a rendered drive as a dataset: images, poses, calibration and boxes."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from drivesplat.editing.actors import actor_placements
from drivesplat.editing.drive_labels import labelled
from drivesplat.editing.film import edited_frames
from drivesplat.editing.render_plan import image_render_plan
from drivesplat.io.prefetch import prefetch_items
from drivesplat.io.storage import Provenance, atomic_write, write_json
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.readers.drive.write import write_record
from drivesplat.readers.nuscenes.write import write_nuscenes
from drivesplat.rendering.frames import film_frames
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import last_training_timestamp
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
    rendered; the scene of the tables is called by scene and edit or trajectory. Raises what `image_render_plan` raises;
    DeviceError; ResultError where a rendering contains NaN or Inf, or the disk is full.
    """
    folder, what = path.parent, " ".join(f"{key} {value}" for key, value in source.items())
    _remove(folder)
    model, device = open_model(checkpoint, device_settings)
    drive = image_render_plan(scene, model, job, folder, what)
    try:
        with explain_out_of_memory(lambda: len(model)):
            views = drive.views(device)
            if drive.edited:
                pictures = edited_frames(model, views, actor_placements(drive.objects.actors, drive.seconds))
            else:
                model.precompute(drive.seconds.tolist())
                pictures = film_frames(model, ((view, None) for view in views))
            for frame, pixels in zip(drive.scene.frames, prefetch_items(pictures), strict=True):
                with atomic_write(Path(frame.image_path)) as file:
                    Image.fromarray(pixels).save(file, format="JPEG", quality=QUALITY, subsampling=0)
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
            **source, "steps": steps, "trained_until": labels.trained_until, "shown_by": labels.shown_by
        }  # fmt: skip
        log = {"logfile": "rendered-by-drivesplat", "vehicle": "rendered", "date_captured": "", "location": what}
        write_nuscenes(marked, labels, folder / TABLES, VERSION, log)
        write_json(folder / TABLES / "provenance.json", {"rendered": rendered, "provenance": provenance})
        write_record(path, replace(marked, tracks=drive.tracks), {**rendered, "provenance": provenance})
    except BaseException:
        _remove(folder)
        raise


def _remove(folder: Path) -> None:
    """Removes the images and tables of an earlier or a failed run."""
    for part in (folder / "images", folder / TABLES):
        if part.exists():
            shutil.rmtree(part)
