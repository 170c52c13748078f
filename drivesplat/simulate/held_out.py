"""What eval.json states of the held-out images and scans of a drive."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.io.storage import read_json, unreadable

GROUPS = ("interpolation", "extrapolation")
"""The groups of held-out images to whose PSNR a drive is fitted."""
Read = TypeVar("Read")


@dataclass(frozen=True)
class HeldOut:
    """A group of held-out images: its `name`, the indices of its `images`, and the mean of their PSNR (dB)."""

    name: str
    images: list[int]
    psnr: float


def held_out_images(drive: TrainedDrive) -> list[HeldOut]:
    """The groups of held-out images in eval.json beside the model; none without this file. Raises ResultError for an
    invalid one."""
    record, found = drive.record, []
    camera = read_metrics(drive, lambda content: content["protocol"]["eval_camera"])
    for name, psnr in held_out_figures(drive, "all", "psnr_frame_mean").items():
        own = (int(index) for index in record.splits.get(name, ()))
        images = [index for index in own if record.is_key_frame[index] and record.camera_name(index) == camera]
        if images:
            found.append(HeldOut(name, images, psnr))
    return found


def held_out_figures(drive: TrainedDrive, *keys: str) -> dict[str, float]:
    """The figure of these keys of each group of GROUPS that has it in eval.json beside the model; none without this
    file. Raises ResultError for an invalid one."""

    def figures(content: dict[str, Any]) -> dict[str, float]:
        found = {}
        for name in GROUPS:
            value = content["result"].get(name)
            for key in keys:
                value = None if value is None else value.get(key)
            if value is not None:
                found[name] = float(value)
        return found

    return read_metrics(drive, figures) or {}


def read_metrics(drive: TrainedDrive, read: Callable[[dict[str, Any]], Read]) -> Read | None:
    """What `read` takes from eval.json beside the model; None without this file. Raises ResultError where it is not as
    `read` expects."""
    file = drive.folder / "eval.json"
    if not file.is_file():
        return None
    content = read_json(file, "evaluate")
    try:
        return read(content)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(file, "evaluate", f"not a record of metrics ({error})") from error
