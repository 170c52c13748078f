"""The stage `export`: a trained model as splat.ply, with the trajectory in cameras.json."""

import logging
from pathlib import Path
from typing import Any

from drivesplat.export.cameras_json import cameras_record
from drivesplat.export.splat_ply import write_splat_ply
from drivesplat.export.trained_parts import digests, trained_parts
from drivesplat.model.gaussians import concatenate
from drivesplat.scene import Scene
from drivesplat.storage import write_json
from drivesplat.training.run import trained_model

log = logging.getLogger(__name__)


def export_splat(
    splat: str | Path,
    cameras: str | Path,
    checkpoint: dict[str, Any],
    parser: dict[str, Any],
    scene: Scene,
    provenance: dict[str, Any],
) -> None:
    """Writes all Gaussians of a checkpoint's content to `splat` and the recorded cameras to `cameras`.

    The header of `splat` has only the digests of `provenance`; all of it, in `cameras`, is too long for viewers.
    """
    model, _ = trained_model(checkpoint)
    gaussians = concatenate(list(trained_parts(model, scene).values()))
    write_splat_ply(splat, gaussians, {"scene": scene.name, "origin": scene.origin.tolist(), **digests(provenance)})
    write_json(cameras, {**cameras_record(scene, parser), "provenance": provenance})
    log.info("%d Gaussians, %d images", len(gaussians), len(scene.frames))
