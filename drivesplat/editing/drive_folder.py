"""The stage `drive_folder`: writes a rendered drive as a dataset: images, poses, calibration, and boxes of what the
images show."""

import logging
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from drivesplat.editing.assets.asset import NO_INSERTS, Inserts
from drivesplat.editing.film import edited_frames
from drivesplat.editing.placed_model import placed_models
from drivesplat.editing.render_plan import ImageRenderPlan, image_render_plan
from drivesplat.editing.shown_objects import NONE
from drivesplat.io.jpeg import encoded_jpeg
from drivesplat.io.prefetch import prefetch_items
from drivesplat.io.storage import Provenance, atomic_write, write_json
from drivesplat.lidar.sweeps import nearest_returns
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.readers.drive.write import write_record
from drivesplat.readers.nuscenes.write import ImageBox, Labels, write_nuscenes
from drivesplat.readers.truth import depth_units, numbered
from drivesplat.rendering.frames import film_frames
from drivesplat.scene.images import write_png
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.splits import last_training_timestamp
from drivesplat.scene.tracks import in_box
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.export import DriveJob, DriveLabel

TABLES, VERSION = "nuscenes", "v1.0-rendered"
"""The folder of the nuScenes dataset in a drive folder, and the name of its version."""
log = logging.getLogger(__name__)
LEVELS = (0.4, 0.6, 0.8)
"""The visible shares between nuScenes' levels of visibility, which count from 1."""


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
        drive_log = {"logfile": "rendered-by-drivesplat", "vehicle": "rendered", "date_captured": "", "location": what}
        write_nuscenes(marked, labels, folder / TABLES, VERSION, drive_log)
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


def labelled(
    scene: Scene, drive: ImageRenderPlan, trained_until: int | None, device: torch.device, where: str
) -> tuple[ImageRenderPlan, Labels]:
    """The drive with the boxes of what it shows, their visibility known at key frames, and the labels of its images.

    An object without Gaussians of its own keeps its boxes if the background shows it in an image of a key frame. Warns,
    starting with `where`, of moving objects whose boxes are left out. `trained_until` (microseconds; None: unknown) is
    the time of the last training image. Raises DeviceError where the GPU runs out of memory.
    """
    frames, objects = zip(drive.scene.frames, drive.views(device), strict=True), drive.objects
    seen = [(frame, objects.seen_in(view)) for frame, view in frames if frame.is_key_frame]
    shown_by = objects.shown_by({item.id for _, found in seen for item in found})
    others = zip(objects.others, objects.parts, strict=True)
    traces = sum(shown_by[item.id] == NONE and not parts for item, parts in others)
    if traces:
        log.warning(
            "%s: moving objects without Gaussians of their own in this model: %d. Their boxes are left out, and images "
            "may show traces of them",
            where, traces,
        )  # fmt: skip
    levels: dict[tuple[str, int], int] = {}  # by object and key frame, in the image that shows most of the object
    for frame, found in seen:
        for item in found:
            key, level = (item.id, frame.sample_index), 1 + int(np.searchsorted(LEVELS, item.visible, side="right"))
            levels[key] = max(level, levels.get(key, 1))
    index_of = {time: index for index, time in enumerate(drive.scene.key_frame_timestamps.tolist())}

    def shown(tracks: Sequence[Track]) -> tuple[Track, ...]:
        """Those that the drive shows, with a visibility of 1 at key frames without them, and of 0 between."""
        kept = []
        for track in (track for track in tracks if shown_by[track.id] != NONE):
            indices = (index_of.get(time) for time in track.timestamps.tolist())
            known = [0 if index is None else levels.get((track.id, index), 1) for index in indices]
            kept.append(replace(track, visibility=np.array(known)))
        return tuple(kept)

    tracks = shown(drive.scene.tracks)
    boxes = [ImageBox(frame, item.id, item.corners, item.visible) for frame, found in seen for item in found]
    sources = {item.id: item.source for item in (*objects.actors, *objects.others)}
    points = _lidar_points(scene, {sources[track.id] for track in tracks})
    counts = {}
    for track in tracks:  # a key frame without a count has that of the nearest one
        own = points[sources[track.id]] or {0: 0}  # an inserted object was not measured
        known = np.array(sorted(own))
        counts[track.id] = [own[int(known[np.abs(known - index).argmin()])] for index in track.sample_indices.tolist()]
    labels = Labels(shown_by, counts, boxes, trained_until)
    return replace(drive, scene=replace(drive.scene, tracks=tracks), tracks=shown(drive.tracks)), labels


def _lidar_points(scene: Scene, ids: set[str]) -> dict[str, dict[int, int]]:
    """The number of returns in the recorded boxes of tracks, by key frame: those of each LiDAR's sweep that is nearest
    to it. Sweeps that cannot be read have none."""
    counts: dict[str, dict[int, int]] = {name: {} for name in ids}
    for index, time in enumerate(scene.key_frame_timestamps.tolist()):
        boxes = [(track, np.flatnonzero(track.sample_indices == index)) for track in scene.tracks if track.id in ids]
        returns = [
            nearest_returns([sweep for sweep in scene.sweeps if sweep.lidar == name], time, scene.key_frame_interval)
            for name in sorted({sweep.lidar for sweep in scene.sweeps})
        ]
        points = np.concatenate([np.zeros((0, 3)), *(found for found in returns if found is not None)])
        for track, at in boxes:
            if len(at):
                counts[track.id][index] = int(in_box(points, track.object_to_world[at[0]], track.size).sum())
    return counts
