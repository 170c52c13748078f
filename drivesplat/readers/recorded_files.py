"""The faults of the files of a drive's recordings: each is opened once, several at a time."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from drivesplat.readers.image_file import image_fault
from drivesplat.readers.record_names import counted
from drivesplat.readers.sweeps import sweep_fault
from drivesplat.scene.scene import Frame, Sweep


def faults_of_images(frames: Sequence[Frame]) -> list[str | None]:
    """For each image the fault of its file, None where there is none."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(image_fault, frames))


def faults_of_sweeps(sweeps: Sequence[Sweep]) -> list[str | None]:
    """For each sweep the fault of its file, None where there is none."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(sweep_fault, sweeps))


def said_once(frames: Sequence[Frame], faults: Sequence[str | None]) -> list[str]:
    """The faults of images, where several have the same one with their number in place of their names."""
    alike: dict[str, list[str]] = {}
    for frame, fault in zip(frames, faults, strict=True):
        if fault:
            alike.setdefault(fault.replace(frame.image_path, ""), []).append(f"frame {frame.token}: {fault}")
    return [
        first + (f" ({counted(len(others), 'other image')} the same)" if others else "")
        for first, *others in alike.values()
    ]
