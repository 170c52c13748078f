"""How far a simulation can be trusted: what its environment, its runs and its policies are told."""

from functools import cached_property

from drivesplat.drive.cameras import PoseableCamera
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError
from drivesplat.simulate.scan_validity import ScanKnowledge, ScanValidity
from drivesplat.simulate.simulation import Simulation
from drivesplat.simulate.validity import ViewKnowledge, ViewValidity


class Trust:
    """What tells how far images and scans of a drive can be trusted: made when it is first needed, once for all
    simulations of the drive."""

    def __init__(self, drive: TrainedDrive):
        self.drive = drive

    @cached_property
    def images(self) -> ViewKnowledge:
        """Of images. Raises RequestError as `ViewKnowledge.of_drive`."""
        return ViewKnowledge.of_drive(self.drive)

    @cached_property
    def scans(self) -> ScanKnowledge:
        """Of scans. Raises RequestError as `ScanKnowledge.of_drive`."""
        return ScanKnowledge.of_drive(self.drive)

    def image(self, now: Simulation, camera: PoseableCamera | None = None) -> ViewValidity | None:
        """How far the image of a camera, by default of the first one, can be trusted; None without one."""
        if camera is None and not now.cameras:
            return None
        return self.images.validity(now.world(), now.view(camera))

    def scan(self, now: Simulation) -> ScanValidity | None:
        """How far the scan can be trusted; None without a LiDAR."""
        return None if now.lidar is None else self.scans.validity(now.world(), now.scan())

    def inform(self, simulation: Simulation) -> None:
        """Lets `Simulation.facts` state `validity`, that of the image of the first camera, and `scan_validity`, where
        the settings want it. Raises RequestError where there is neither a camera nor a LiDAR."""
        if not simulation.settings.validity:
            return
        if not simulation.cameras and simulation.lidar is None:
            raise RequestError(
                f"{self.drive.where}: 'validity' is that of an image or a scan; name a camera in 'cameras', or a "
                "'lidar'"
            )
        _ = self.images if simulation.cameras else None, self.scans if simulation.lidar is not None else None

        def stated() -> dict[str, float]:
            found = {"validity": self.image(simulation), "scan_validity": self.scan(simulation)}
            return {name: own.validity for name, own in found.items() if own is not None}

        simulation.trust = stated
