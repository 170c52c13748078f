"""The stage `film`: a trained model along a trajectory, as a film and the cameras that it was seen from."""

import logging
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from drivesplat.device import choose_device, telling_out_of_memory
from drivesplat.errors import ResultError
from drivesplat.model.splat_model import SplatModel, View
from drivesplat.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import FilmJob
from drivesplat.training.run import trained_model
from drivesplat.trajectory import CameraPath, film_intrinsics, film_path, recorded_frames
from drivesplat.video import write_video

log = logging.getLogger(__name__)


def render_film(
    scene: Scene, checkpoint: dict[str, Any], job: FilmJob, device_settings: DeviceSettings, path: Path
) -> dict[str, Any]:
    """Writes the MP4 `path`; returns the content of the record of its cameras, provenance aside.

    `checkpoint` is the content of checkpoint.pt. Raises DatasetError where the scene lacks the camera, DeviceError,
    and ResultError where the film cannot be written or the model renders no numbers.
    """
    began = time.perf_counter()
    cameras = film_path(scene, job.camera, job.fps, job.trajectory)
    frame = recorded_frames(scene, job.camera)[0]
    K = film_intrinsics(frame, job.width, job.height, job.horizontal_fov)
    device = choose_device(device_settings, min_free_gb=0.0)
    model, _ = trained_model(checkpoint)
    log.info("%s: %d frames of %dx%d on %s", path.name, len(cameras), job.width, job.height, device)
    views = film_views(scene, cameras, K, (job.width, job.height), device)
    shown = tqdm(
        views, total=len(cameras), desc=path.stem, unit="frame", disable=not sys.stderr.isatty(), mininterval=1.0
    )
    with telling_out_of_memory(lambda: len(model)):
        model.to(device)
        pictures = (film_frame(model, view) for view in shown)
        write_video(path, pictures, (job.width, job.height), job.fps, job.crf, threads=torch.get_num_threads())
    seconds = time.perf_counter() - began
    log.info("%s: %.1f s, %.3f s a frame", path.name, seconds, seconds / len(cameras))
    return {**film_record(scene, cameras, K, job), "render_seconds": seconds, "bytes": path.stat().st_size}


def film_record(scene: Scene, cameras: CameraPath, K: np.ndarray, job: FilmJob) -> dict[str, Any]:
    """What another program needs to see what the film sees.

    `K` in continuous pixels; `timestamps` microseconds; `camera_to_world` OpenCV cameras in world metres, z up;
    global = world + `origin`; `offset` in metres and degrees from the recorded path.
    """
    return {
        "schema": 1,
        "camera": job.camera,
        "fps": job.fps,
        "width": job.width,
        "height": job.height,
        "frames": len(cameras),
        "duration_s": len(cameras) / job.fps,
        "K": K.tolist(),
        "timestamps": cameras.timestamps.tolist(),
        "camera_to_world": cameras.camera_to_world.tolist(),
        "origin": scene.origin.tolist(),
        "offset": job.trajectory.model_dump(),
    }


def film_views(
    scene: Scene, cameras: CameraPath, K: np.ndarray, size: tuple[int, int], device: torch.device
) -> Iterator[View]:
    """The cameras one by one, on the device; `K` (3, 3) continuous pixels at `size` (width, height)."""
    intrinsics = torch.from_numpy(K).float().to(device)
    for timestamp, camera_to_world in zip(cameras.timestamps, cameras.camera_to_world, strict=True):
        pose = torch.from_numpy(camera_to_world).float().to(device)
        yield View(intrinsics, pose, *size, time=scene.seconds(timestamp))


@torch.no_grad()
def film_frame(model: SplatModel, view: View) -> np.ndarray:
    """What a view shows, (h, w, 3) uint8 RGB. Raises ResultError where that is not finite."""
    image = model.render(view).image
    finite = torch.isfinite(image).all()
    pixels = (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy()
    if not finite:  # asked after the copy, which has waited for the device anyway
        raise ResultError("a frame of a film was rendered as no numbers; delete its checkpoint.pt and rerun")
    return pixels
