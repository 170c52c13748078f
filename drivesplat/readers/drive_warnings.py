"""All warnings about a drive whose records are sound: poses, sensors, boxes and clocks compared with each other."""

from drivesplat.readers.drive_checks import jumps
from drivesplat.readers.image_agreement import image_warnings
from drivesplat.readers.plausibility import lidar_warnings, pose_warnings
from drivesplat.readers.sampled_sweeps import SampledSweep, sampled_sweeps
from drivesplat.readers.sweep_agreement import agreement_warnings
from drivesplat.readers.track_plausibility import path_warnings, shape_warnings
from drivesplat.readers.track_returns import box_warnings, frame_warnings
from drivesplat.scene.scene import UNPOSED, Scene


def drive_warnings(scene: Scene) -> list[str]:
    """Sentences about what contradicts each other in a drive, with the measured figure and the likely cause. Reads a
    few sweeps and images."""
    found = [*jumps(scene), *pose_warnings(scene), *lidar_warnings(scene)]
    if scene.poses == UNPOSED or found:
        return [*found, *shape_warnings(scene.tracks)]
    sweeps = sampled_sweeps(scene)
    return [*agreement_warnings(sweeps), *image_warnings(scene, sweeps), *track_warnings(scene, sweeps)]


def track_warnings(scene: Scene, sweeps: list[SampledSweep]) -> list[str]:
    """Sentences about tracks: the first kind of mistake that is found, since it causes others."""
    return (
        shape_warnings(scene.tracks)
        or frame_warnings(scene, sweeps)
        or path_warnings(scene)
        or box_warnings(scene, sweeps)
    )
