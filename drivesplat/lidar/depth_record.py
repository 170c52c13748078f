"""What lidar_depth.pkl holds: the depth that LiDAR gives some pixels of every training image.

    images      one for each of the scene's frames, in their order; empty arrays where it is no training image
        rows, columns    (m,) int32: the pixels, at the size at which images are trained; none twice
        depth            (m,) float32: metres along the camera's axis
    provenance

The stage `lidar_depth` makes it (`drivesplat.preprocess.lidar_depth`).
"""

from pathlib import Path
from typing import Any

from drivesplat.io.plain_pickle import read_plain_pickle
from drivesplat.io.storage import unreadable


def read_lidar_depth(path: str | Path) -> dict[str, Any]:
    """Reads lidar_depth.pkl. Raises ResultError, naming the file and the rule that makes it, where it is not one."""
    content = read_plain_pickle(path, rule="lidar_depth")
    try:
        if not content.keys() >= {"images", "provenance"}:
            raise ValueError("it lacks the keys of one")
        if any(not image.keys() >= {"rows", "columns", "depth"} for image in content["images"]):
            raise ValueError("an image in it lacks keys")
    except (AttributeError, TypeError, ValueError) as error:
        raise unreadable(path, "lidar_depth", f"not a record of depths ({error})") from error
    return content
