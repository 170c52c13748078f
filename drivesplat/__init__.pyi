"""What type checkers know of the package: `drivesplat.__getattr__` imports these names when they are first used."""

from pathlib import Path

from drivesplat.drive.cameras import PoseableCamera as Camera
from drivesplat.drive.lidars import PoseableLidar as Lidar
from drivesplat.drive.live_server import LiveServer as LiveServer
from drivesplat.drive.long_drive import LongDrive as LongDrive
from drivesplat.drive.render_files import render_poses as render_poses
from drivesplat.drive.trained_drive import TrainedDrive as TrainedDrive
from drivesplat.drive.trained_drive import open_drive as open

IS_CHECKOUT: bool
WORKFLOW: Path
SNAKEFILE: Path

__all__ = ["Camera", "Lidar", "LiveServer", "LongDrive", "TrainedDrive", "open", "render_poses"]
