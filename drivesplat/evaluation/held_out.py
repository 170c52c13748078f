"""The images that are measured."""

from drivesplat.errors import DatasetError
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.scene.training_record import TrainingRecord


def held_out_images(record: TrainingRecord, group: str, camera: str) -> list[int]:
    """The images of `group` that are measured: key frames of the evaluated camera. Of 'train' likewise.

    Raises DatasetError where the scene does not hold that camera.
    """
    if camera not in record.camera_names:
        raise DatasetError(
            f"eval_camera {camera} is not among the cameras of this run ({', '.join(record.camera_names)})"
        )
    wanted = record.camera_names.index(camera)
    return [int(i) for i in record.splits[group] if record.camera_indices[i] == wanted and record.is_key_frame[i]]


def measured_images(record: TrainingRecord, camera: str) -> dict[str, list[int]]:
    """The images that are measured, by held-out group. Raises what `held_out_images` raises."""
    return {group: held_out_images(record, group, camera) for group in HELD_OUT_GROUPS}
