"""A long drive in Python: its blocks, of which those that are rendered are in memory."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.drive.drive_view import DriveScan
from drivesplat.drive.lidars import PoseableLidar
from drivesplat.drive.trained_drive import TrainedDrive, open_drive
from drivesplat.drive.world_state import AnyCamera
from drivesplat.errors import RequestError
from drivesplat.model.checkpoint import CHECKPOINT
from drivesplat.scene.blocks import blocks_left_out, drive_scene, read_blocks
from drivesplat.scene.scene import Scene
from drivesplat.settings.blocks import BLOCKS
from drivesplat.settings.device import DeviceSettings

POSES = {"ego_to_world", "camera_to_world", "sensor_to_world"}
"""The arguments of a rendering that are poses."""
MAX_OPEN = 2
"""The blocks that are in memory."""


class LongDrive:
    """A drive that was cut into blocks. Times are seconds since the drive's first image; poses are in the world of the
    drive, in metres with z up.

    >>> drive = drivesplat.LongDrive("results/commute/street")
    >>> image = drive.render("CAM_FRONT", time=431.0).image
    >>> block, seconds = drive.at(431.0)
    >>> block.actors.loc["bf53", "speed"]
    8.4
    """

    def __init__(self, folder: str | Path, device: str | DeviceSettings = "any"):
        """Opens the drive with the method's result folder `folder`, results/{scene}/{method}. `device`: as for
        `drivesplat.open`.

        Raises RequestError for a scene that is not cut into blocks, ResultError for damaged files.
        """
        self.folder, self._device = Path(folder), device
        results = self.folder.parent
        if not (results / BLOCKS).is_file():
            raise RequestError(f"{results} has no {BLOCKS}: it is no drive that is cut into blocks (drivesplat.open)")
        self.blocks = read_blocks(results / BLOCKS)
        self._open: dict[int, TrainedDrive] = {}

    def __repr__(self) -> str:
        return f"<LongDrive {self.folder}: {self.duration:.1f} s in {len(self.blocks.blocks)} blocks>"

    @cached_property
    def scene(self) -> Scene:
        """The record of the whole drive."""
        return drive_scene(self.folder.parent, self.blocks)

    @cached_property
    def _first(self) -> int:
        """The timestamp of second 0."""
        return min(recording.timestamp for recording in self.scene.frames or self.scene.sweeps)

    @property
    def left_out(self) -> list[int]:
        """The numbers of the blocks that cannot be rendered: those without a trained model, and those that the figures
        of the drive leave out (`datasets.*.blocks.leave_out`)."""
        names = blocks_left_out(self.folder)
        return [
            number
            for number, name in enumerate(self.blocks.names)
            if name in names or not (self._folder_of(number) / CHECKPOINT).is_file()
        ]

    def _folder_of(self, number: int) -> Path:
        """The folder of a block's method."""
        return self.folder.parents[1] / self.blocks.names[number] / self.folder.name

    @cached_property
    def duration(self) -> float:
        """The time of the last image in seconds; of the last sweep without images."""
        recordings = self.scene.frames or self.scene.sweeps
        return self.scene.seconds(max(recording.timestamp for recording in recordings))

    def block(self, number: int) -> TrainedDrive:
        """A block as a drive of its own, with times from its first image and a world with an origin of its own. Raises
        RequestError for an unknown one, and one that is `left_out`."""
        if not 0 <= number < len(self.blocks.blocks):
            raise RequestError(f"{self.folder} has no block {number}; it has {len(self.blocks.blocks)}, from 0 on")
        if number not in self._open:
            if number in self.left_out:
                raise RequestError(
                    f"block {number} of {self.folder} is left out or not trained: {self._folder_of(number)} cannot be "
                    "rendered as part of the drive; LongDrive.left_out lists such blocks. Once it is trained, and no "
                    "longer in leave_out, make metrics.json of the drive again (docs/long_drives.md)"
                )
            while len(self._open) >= MAX_OPEN:
                self._open.pop(next(iter(self._open)))
            self._open[number] = open_drive(self._folder_of(number), self._device)
        self._open[number] = self._open.pop(number)
        return self._open[number]

    def at(self, time: float) -> tuple[TrainedDrive, float]:
        """The block in which the vehicle is at a time, and that time in seconds since the block's first image. Raises
        RequestError for a time outside of the recording, and in a block that is `left_out`."""
        if not 0.0 <= time <= self.duration:
            raise RequestError(f"{self.folder} was recorded from 0 to {self.duration:.2f} s, not at {time:g} s")
        timestamp = self._first + round(time * 1e6)
        drive = self.block(self.blocks.at(timestamp))
        return drive, float(np.clip(drive.scene.seconds(timestamp), 0.0, drive.duration))

    def render(self, camera: AnyCamera | Sequence[AnyCamera], time: float, **at: Any) -> Any:
        """What a camera sees at a time (a `DriveView`), or each of several (a list): `TrainedDrive.render`, whose
        further arguments it has."""
        drive, seconds = self.at(time)
        return drive.render(camera, seconds, **self._in_block(at, drive))

    def scan(self, lidar: str | PoseableLidar, time: float, **at: Any) -> DriveScan:
        """What a LiDAR measures about a time, in the world of the block: `TrainedDrive.scan`, whose further arguments
        it has."""
        drive, seconds = self.at(time)
        return drive.scan(lidar, seconds, **self._in_block(at, drive))

    def _in_block(self, at: Mapping[str, Any], drive: TrainedDrive) -> dict[str, Any]:
        """Arguments of a rendering, with poses of the drive's world in that of a block."""
        moved = dict(at)
        for name in POSES & at.keys():
            pose = None if at[name] is None else np.array(at[name], dtype=np.float64)
            if pose is not None and pose.shape == (4, 4):  # anything else is refused by the block
                pose[:3, 3] += self.scene.origin - drive.scene.origin
            moved[name] = pose
        return moved
