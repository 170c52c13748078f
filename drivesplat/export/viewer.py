"""The stage `export_viewer`: a trained model as viewer.html, one page that needs a browser and no network.

The page uses the WebGL 2 code in `viewer_page/`, which projects, culls and colours as gsplat does, including spherical
harmonics, moves and deforms the groups over time, and shows the learned sky. The page contains no addresses, and its
content security policy prevents requests.

The payload is base64 of zlib-compressed little-endian arrays, each at a multiple of 4 bytes, listed in the JSON of
#scene (`viewer_scene`).
"""

import base64
import io
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from drivesplat.export import viewer_page as template
from drivesplat.export.modes import fitted_modes
from drivesplat.export.thinning import thinned_groups
from drivesplat.export.trained_parts import trained_groups
from drivesplat.export.viewer_boxes import box_motions
from drivesplat.export.viewer_scene import ViewerContent, recorded_path, scene_record
from drivesplat.io.html_page import filled_page
from drivesplat.io.storage import Provenance, atomic_write
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.scene.images import read_image
from drivesplat.scene.scene import Scene
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.export import ViewerJob
from drivesplat.trajectories.camera_path import recorded_frames, recorded_timestamps
from drivesplat.trajectories.sampled_edit import SampledEdit

log = logging.getLogger(__name__)

SKY_SIZE = 256
"""Texels along an edge of the sky's cube map."""
JPEG_QUALITY = 80
"""Of the recorded images to compare with, up to 95."""


def export_viewer(
    path: str | Path,
    checkpoint: TrainedCheckpoint,
    scene: Scene,
    record: TrainingRecord,
    job: ViewerJob,
    method: str,
    edits: Sequence[SampledEdit],
    provenance: Provenance,
) -> None:
    """Writes the page with the `job.gaussians` Gaussians of a checkpoint that have the largest coverage, viewed along
    the path of `job.eval_camera`.

    Objects move as recorded or as one of `edits` says, in the colours of the shown time. Raises DatasetError if the
    scene has no image of that camera or one of its key frames cannot be read.
    """
    model, recorded = trained_model(checkpoint), recorded_path(scene, record, job.eval_camera)
    groups = trained_groups(model, scene, recorded_timestamps(scene, job.eval_camera), job.time_s)
    kept = thinned_groups(groups, job.gaussians)
    content = ViewerContent(
        kept, model.sky, model.antialiased, recorded,
        edits=edits,
        images=key_frame_images(scene, record, job.eval_camera, job.image_width),
        method=method, methods=job.methods, modes=fitted_modes(model, kept), boxes=box_motions(scene, kept),
    )  # fmt: skip
    page = viewer_page(content, f"{scene.name} · {method}", provenance)
    with atomic_write(path) as file:
        file.write(page.encode())
    after, before = (sum(len(group.gaussians) for group in of.values()) for of in (kept, groups))
    log.info("%d of %d Gaussians, %.1f MB", after, before, len(page) * 1e-6)


def viewer_page(content: ViewerContent, title: str, provenance: Provenance) -> str:
    """The text of the page, deterministic. Its first view is that of the path's first pose; without a sky the
    background is black."""
    scene, payload = scene_record(content, SKY_SIZE)
    encoded = base64.b64encode(payload).decode()
    return filled_page(template, title=title, provenance=provenance, scene=scene, payload=encoded)


def key_frame_images(scene: Scene, record: TrainingRecord, camera: str, width: int) -> list[dict[str, Any]]:
    """The recorded images to compare with: for every key frame of a camera its `second`, whether it was `trained` on,
    and its `image` as the address that contains it, `width` pixels wide at most; none if that is 0.

    Raises DatasetError that names an image that cannot be read.
    """
    trained = {(record.camera_name(i), int(record.timestamps[i])) for i in record.train_images}
    frames = [frame for frame in recorded_frames(scene, camera) if frame.is_key_frame] if width else []
    images = []
    for frame in frames:
        columns = min(width, frame.width)
        pixels = read_image(frame.image_path, (columns, max(1, round(frame.height * columns / frame.width))))
        content = io.BytesIO()
        Image.fromarray(pixels).save(content, format="JPEG", quality=JPEG_QUALITY)
        images.append(
            {
                "second": scene.seconds(frame.timestamp),
                "trained": (camera, frame.timestamp) in trained,
                "image": f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}",
            }
        )
    return images
