"""The recorded images at key frames, small, for viewer.html to compare with."""

import base64
import io
from typing import Any

from PIL import Image

from drivesplat.scene.images import read_image
from drivesplat.scene.scene import Scene
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.trajectories.camera_path import recorded_frames

QUALITY = 80
"""Of JPEG, up to 95."""


def key_frame_images(scene: Scene, record: TrainingRecord, camera: str, width: int) -> list[dict[str, Any]]:
    """For every key frame of a camera its `second`, whether it was `trained` on, and its `image` as the address that
    contains it: `width` pixels wide at most; none if that is 0.

    Raises DatasetError that names an image that cannot be read.
    """
    trained = {(record.camera_name(i), int(record.timestamps[i])) for i in record.train_images}
    frames = [frame for frame in recorded_frames(scene, camera) if frame.is_key_frame] if width else []
    images = []
    for frame in frames:
        columns = min(width, frame.width)
        pixels = read_image(frame.image_path, (columns, max(1, round(frame.height * columns / frame.width))))
        content = io.BytesIO()
        Image.fromarray(pixels).save(content, format="JPEG", quality=QUALITY)
        images.append(
            {
                "second": scene.seconds(frame.timestamp),
                "trained": (camera, frame.timestamp) in trained,
                "image": f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}",
            }
        )
    return images
