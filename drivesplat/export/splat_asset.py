"""The stage `export`: a trained model as splat.ply and, part by part, as PLYs of their own; cameras.json and parts.json
have the trajectory it was recorded along and the motion of its objects."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.export.cameras_json import cameras_record
from drivesplat.export.parts_json import write_parts
from drivesplat.export.splat_ply import write_splat_ply
from drivesplat.export.trained_parts import digests, trained_gaussians, trained_groups
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import trained_model
from drivesplat.scene.scene import Scene
from drivesplat.scene.training_record import TrainingRecord

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SplatFiles:
    """What the stage writes; the PLYs of the parts lie beside `parts`."""

    splat: str | Path
    cameras: str | Path
    parts: str | Path


def export_splat(
    files: SplatFiles, checkpoint: dict[str, Any], record: TrainingRecord, scene: Scene, provenance: dict[str, Any]
) -> None:
    """Writes all Gaussians of a checkpoint's content: together as they stand when the middle image was taken, and part
    by part; with the recorded cameras.

    The headers of PLYs have only the digests of `provenance`; all of it, in the JSON files, is too long for viewers.
    """
    model, _ = trained_model(checkpoint)
    gaussians = trained_gaussians(model, scene)
    groups = trained_groups(model, scene, np.array([frame.timestamp for frame in scene.frames]))
    note = {"scene": scene.name, "origin": scene.origin.tolist(), **digests(provenance)}
    write_splat_ply(files.splat, gaussians, note)
    write_json(files.cameras, {**cameras_record(scene, record), "provenance": provenance})
    write_parts(files.parts, groups, scene, provenance)
    log.info("%d Gaussians, %d groups, %d images", len(gaussians), len(groups), len(scene.frames))
