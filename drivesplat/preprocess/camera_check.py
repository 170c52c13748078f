"""Whether images of a recorded drive agree with the intrinsics of their cameras, in sentences."""

import tempfile
from pathlib import Path

from drivesplat.errors import DatasetError
from drivesplat.preprocess.intrinsics import intrinsics_warnings
from drivesplat.preprocess.undistort import undistorted
from drivesplat.scene.scene import Scene


def camera_warnings(scene: Scene) -> list[str]:
    """`intrinsics_warnings`, and sentences about cameras whose images contradict their intrinsics, by a trial with some
    images (`drivesplat.poses.lens`)."""
    return [*intrinsics_warnings(scene), *_image_warnings(scene)]


def _image_warnings(scene: Scene) -> list[str]:
    try:
        from drivesplat.poses.lens import lens_warnings, with_tested_images  # imports pycolmap
    except ImportError as error:
        return [f"intrinsics are not compared with images: pycolmap or pyceres cannot be imported ({error})"]
    tested = with_tested_images(scene)
    with tempfile.TemporaryDirectory(prefix="drivesplat-undistorted-") as folder:
        try:
            return lens_warnings(undistorted(tested, Path(folder)))
        except DatasetError as error:
            return [f"intrinsics are not compared with images: {error}"]
