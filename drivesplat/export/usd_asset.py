"""The stage `export_usd`: a trained model and the camera that recorded it as scene.usdz."""

import logging
from pathlib import Path
from typing import Any

from pxr import Gf

from drivesplat.errors import DatasetError
from drivesplat.export.thinning import thinned_parts
from drivesplat.export.trained_parts import digests, trained_parts
from drivesplat.export.usd import splat_stage, usd_camera, write_usdz
from drivesplat.parser import image_size
from drivesplat.scene import Scene
from drivesplat.settings.export import UsdJob

log = logging.getLogger(__name__)


def export_usd(
    path: str | Path,
    checkpoint: dict[str, Any],
    parser: dict[str, Any],
    scene: Scene,
    job: UsdJob,
    provenance: dict[str, Any],
) -> None:
    """Writes the `job.gaussians` of a checkpoint's content that cover most, and the recorded `job.eval_camera`.

    Raises DatasetError where the scene does not hold that camera.
    """
    parts = trained_parts(checkpoint, scene)
    kept = thinned_parts(parts, job.gaussians)
    cameras = recorded_cameras(scene, parser, job.eval_camera)
    note = {"scene": scene.name, "dataset": scene.dataset, "origin": Gf.Vec3d(*scene.origin), **digests(provenance)}
    write_usdz(path, splat_stage(kept, cameras, note))
    before, after = (sum(map(len, of.values())) for of in (parts, kept))
    log.info("%d of %d Gaussians, %d images of %s", after, before, len(cameras), job.eval_camera)


def recorded_cameras(scene: Scene, parser: dict[str, Any], camera: str) -> list[tuple[float, Gf.Camera]]:
    """The images of a camera as USD's cameras, each with its time in seconds since the scene's first image.

    Raises DatasetError where there are none.
    """
    shown = [(i, frame) for i, frame in enumerate(scene.frames) if frame.camera == camera]
    if not shown:
        known = ", ".join(parser["camera_names"])
        raise DatasetError(f"scene {scene.name}: eval_camera {camera} is not among the cameras of this run ({known})")
    return [
        (scene.seconds(frame.timestamp), usd_camera(parser["Ks"][i], image_size(parser, i), frame.camera_to_world))
        for i, frame in shown
    ]
