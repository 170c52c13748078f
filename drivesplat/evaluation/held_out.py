"""The images on which metrics are computed."""

from drivesplat.errors import DatasetError
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.scene.training_record import TrainingRecord


def held_out_images(record: TrainingRecord, group: str, camera: str) -> list[int]:
    """The indices of the images of `group` (or 'train') that are measured: key frames of the evaluated camera.

    Raises DatasetError if the scene lacks that camera.
    """
    if camera not in record.camera_names:
        raise DatasetError(
            f"eval_camera {camera} is not among the cameras of this run ({', '.join(record.camera_names)})"
        )
    wanted = record.camera_names.index(camera)
    return [int(i) for i in record.splits[group] if record.camera_indices[i] == wanted and record.is_key_frame[i]]


def measured_images(record: TrainingRecord, camera: str) -> dict[str, list[int]]:
    """The indices of the measured images by held-out group. Raises DatasetError as `held_out_images` does."""
    return {group: held_out_images(record, group, camera) for group in HELD_OUT_GROUPS}
