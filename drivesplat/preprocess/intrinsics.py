"""What is implausible in the intrinsics of cameras, in sentences; `camera_check` compares them with images."""

from drivesplat.preprocess.undistort import view_kept
from drivesplat.scene.scene import Scene

MAX_OFFSET = 0.1
"""Largest distance of the principal point from the middle, relative to the width. Its height is not tested: images are
often cut at the top or bottom."""
MIN_KEPT = 0.8
"""Part of the recorded image below which it is said how much resampling keeps."""


def intrinsics_warnings(scene: Scene) -> list[str]:
    """Sentences about cameras whose K looks like one of another image size, and about those whose resampled images show
    much less than the recorded ones. `scene` is as recorded, with distortion that can be undone."""
    off_centre, cut = [], []
    for camera in scene.cameras:
        x, y = camera.intrinsics[:2, 2] + 0.5
        if abs(x / camera.width - 0.5) > MAX_OFFSET:
            off_centre.append(
                f"camera {camera.name}: its principal point ({x:.0f}, {y:.0f}) lies at {x / camera.width:.0%} of the "
                f"width and {y / camera.height:.0%} of the height of its images: K may belong to another image size, "
                f"of about {2 * x:.0f}x{2 * y:.0f} instead of {camera.width}x{camera.height} pixels"
            )
        kept = view_kept(camera)
        if kept < MIN_KEPT:
            cut.append(
                f"camera {camera.name}: pinhole images keep {kept:.0%} of the area of its {camera.distortion_model} "
                "images; the rest of the view is lost"
            )
    return off_centre + cut
