"""The images that are measured."""

from typing import Any

from drivesplat.errors import DatasetError
from drivesplat.scene.splits import HELD_OUT_GROUPS


def held_out_images(parser: dict[str, Any], group: str, camera: str) -> list[int]:
    """The images of `group` that are measured: key frames of the evaluated camera. Of 'train' likewise.

    Raises DatasetError where the scene does not hold that camera.
    """
    if camera not in parser["camera_names"]:
        raise DatasetError(
            f"eval_camera {camera} is not among the cameras of this run ({', '.join(parser['camera_names'])})"
        )
    wanted = parser["camera_names"].index(camera)
    return [
        int(i) for i in parser["splits"][group] if parser["camera_indices"][i] == wanted and parser["is_key_frame"][i]
    ]


def measured_images(parser: dict[str, Any], camera: str) -> dict[str, list[int]]:
    """The images that are measured, by held-out group. Raises what `held_out_images` raises."""
    return {group: held_out_images(parser, group, camera) for group in HELD_OUT_GROUPS}
