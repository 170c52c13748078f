"""The stage `export`: a trained model as splat.ply and as one PLY per rigid group, with the recorded cameras in
cameras.json and the motions of objects in parts.json."""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivesplat.export.cameras_json import cameras_record
from drivesplat.export.parts_json import write_parts
from drivesplat.export.splat_ply import write_splat_ply
from drivesplat.export.trained_parts import digests, trained_gaussians, trained_groups
from drivesplat.io.storage import Provenance, write_json
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.scene.scene import Scene
from drivesplat.scene.training_record import TrainingRecord

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SplatFiles:
    """The outputs of the stage; the PLYs of groups are written beside `parts`."""

    splat: str | Path
    cameras: str | Path
    parts: str | Path


def export_splat(
    files: SplatFiles, checkpoint: TrainedCheckpoint, record: TrainingRecord, scene: Scene, provenance: Provenance
) -> None:
    """Writes all Gaussians of a checkpoint: together at the time of the middle image, and group by group;
    and the recorded cameras.

    PLY headers contain only the digests of `provenance`, since viewers limit their length; JSON files contain all.
    """
    model = trained_model(checkpoint)
    gaussians = trained_gaussians(model, scene)
    groups = trained_groups(model, scene, np.array([frame.timestamp for frame in scene.frames]))
    note = {"scene": scene.name, "origin": scene.origin.tolist(), **digests(provenance)}
    write_splat_ply(files.splat, gaussians, note)
    write_json(files.cameras, {**cameras_record(scene, record), "provenance": provenance})
    write_parts(files.parts, groups, scene, provenance)
    log.info("%d Gaussians, %d groups, %d images", len(gaussians), len(groups), len(scene.frames))
