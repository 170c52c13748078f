"""Renderings of a drive along the poses of a file, as images in a folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.drive.cameras import require_pose
from drivesplat.drive.drive_view import DriveView
from drivesplat.drive.pose_files import read_poses
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError
from drivesplat.io.storage import write_json
from drivesplat.readers.truth import depth_units, numbered
from drivesplat.scene.images import write_png

WRITTEN = ("rgb", "depth", "instance")
"""The outputs that can be written as images."""


def render_poses(
    drive: TrainedDrive,
    poses: str | Path,
    camera: str,
    outputs: Sequence[str],
    folder: str | Path,
    of_ego: bool = False,
) -> int:
    """Writes what a recorded camera sees at the times and poses of a file; returns the number of images of each output.

    Args:
        drive: What is rendered.
        poses: A file of `drivesplat.drive.pose_files.read_poses`: those of the camera, or `of_ego`, of the vehicle.
        camera: The name of a recorded camera.
        outputs: Names from WRITTEN.
        folder: Where `{output}/{number}.png` and `render.json` are written. Depth has 16 bits, 256 units a metre, 0
            where there is no surface; instances have 16 bits, 0 for none, else the number in `objects` of render.json.

    Raises RequestError as `TrainedDrive.render` and `read_poses` do.
    """
    if unknown := [name for name in outputs if name not in WRITTEN]:
        raise RequestError(f"output {unknown[0]!r} cannot be written; there are: {', '.join(WRITTEN)}")
    folder, known = Path(folder), read_poses(poses)
    for time in known.times.tolist():
        drive.recording.checked(time)
    try:
        for name in WRITTEN:  # of an earlier run
            for file in folder.glob(f"{name}/{'[0-9]' * 6}.png"):
                file.unlink()
        for name in outputs:
            (folder / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"{folder} cannot be made: {error.strerror}") from None
    numbers: dict[str, int] = {}
    frames = []
    for number, (time, pose) in enumerate(zip(known.times.tolist(), known.poses, strict=True)):
        at = {"ego_to_world" if of_ego else "camera_to_world": require_pose(pose, f"{poses}, pose {number}")}
        view = drive.render(camera, time, outputs=outputs, **at)
        for item in view.objects:
            numbers.setdefault(item, len(numbers) + 1)
        images = {name: f"{name}/{number:06d}.png" for name in outputs}
        for name, file in images.items():
            write_png(folder / file, _pixels(view, name, numbers))
        frames.append({"time": time, **{name: matrix.tolist() for name, matrix in at.items()}, "images": images})
    intrinsics = drive.camera(camera).K.tolist()
    record: dict[str, Any] = {"camera": camera, "K": intrinsics, "objects": numbers, "frames": frames}
    write_json(folder / "render.json", record)
    return len(frames)


def _pixels(view: DriveView, name: str, numbers: dict[str, int]) -> np.ndarray:
    if name == "rgb":
        return view.image
    values = view.arrays()[name]
    return depth_units(values) if name == "depth" else numbered(values, [numbers[item] for item in view.objects])
