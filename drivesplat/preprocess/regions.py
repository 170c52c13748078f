"""The stage `regions`: the masks of a scene for other tracks than the annotated ones.

Regions are labelled by the boxes of these tracks. Sky, semantic classes and the body of the ego vehicle depend on no
track: their files are those of the stage `masks`, linked where the file system allows it.
"""

import dataclasses
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from drivesplat.readers.files import link_or_copy
from drivesplat.scene.images import target_size, write_png
from drivesplat.scene.masks import MasksRecord, mask_name, read_labels, read_masks_record
from drivesplat.scene.regions import LABELS, label_image, visibility_source
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.masks import RegionJob

SHARED = ("sky", "semantic")
"""The kinds of masks that depend on no track."""


def relabelled_masks(scene: Scene, job: RegionJob, masks: Path, folder: Path) -> MasksRecord:
    """Writes the masks of every image of a scene below `folder`, given those of the stage `masks` in the folder
    `masks`; returns their record with other regions. Raises ResultError where one of them is damaged."""
    made = read_masks_record(masks)

    def label(frame: Frame) -> None:
        size = target_size(frame, job.images)
        labels = label_image(scene, frame, size)
        labels[read_labels(masks, frame.camera, frame.timestamp, size) == LABELS["own_car"]] = LABELS["own_car"]
        write_png(folder / mask_name("regions", frame.camera, frame.timestamp), labels)

    with ThreadPoolExecutor() as pool:
        list(pool.map(label, scene.frames))
    _link(masks, folder, scene.frames)
    return dataclasses.replace(made, regions="boxes", visibility=visibility_source(scene.tracks))


def _link(masks: Path, folder: Path, frames: Iterable[Frame]) -> None:
    for name in (mask_name(kind, frame.camera, frame.timestamp) for frame in frames for kind in SHARED):
        if (masks / name).is_file():
            link_or_copy(masks / name, folder / name)
