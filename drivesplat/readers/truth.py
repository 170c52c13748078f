"""Ground truth of a synthetic world: views from beside the path, images without the leading car, depth, instances.

`truth/truth.json` below a dataset's root lists these images for each key frame of one camera. They are lossless and
free of sensor noise.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from drivesplat.errors import ResultError
from drivesplat.io.storage import read_json, unreadable, write_json

SCHEMA = 1
TRUTH_FILE = "truth/truth.json"
"""Below a dataset's root."""
RULE = "demo_world"


@dataclass(frozen=True)
class TruthFrame:
    """The truth of one key frame: the token of its image's sample_data, its index, file names, and camera poses (4, 4)
    in the dataset's global frame. `without_leading` is None without a leading car."""

    sample_data: str
    sample_index: int
    lateral: str
    without_leading: str | None
    depth: str
    instances: str
    camera_to_global: list[list[float]]
    lateral_camera_to_global: list[list[float]]


@dataclass(frozen=True)
class Truth:
    """The content of truth.json. `lateral_left_m`: offset in metres of the lateral view to the ego vehicle's left;
    `leading`: the instance missing from `without_leading`, None without a leading car; `instances`: token by number in
    the instance images."""

    scene: str
    camera: str
    width: int
    height: int
    samples_per_pixel: int
    lateral_left_m: float
    leading: str | None
    instances: dict[str, str]
    frames: tuple[TruthFrame, ...]

    def by_image(self) -> dict[str, TruthFrame]:
        """The frames by the token of their image's sample_data."""
        return {frame.sample_data: frame for frame in self.frames}


def write_truth_file(root: Path, truth: Truth) -> None:
    """Writes truth.json below a dataset's `root`."""
    write_json(root / TRUTH_FILE, {"schema": SCHEMA, **asdict(truth)})


def read_truth(path: str | Path) -> Truth:
    """Reads truth.json. Raises ResultError that names the file and its rule if it is invalid."""
    content = read_json(path, RULE)
    try:
        if content.pop("schema") != SCHEMA:
            raise ValueError("it has another schema")
        frames = tuple(TruthFrame(**frame) for frame in content.pop("frames"))
        for frame in frames:
            if any(np.shape(pose) != (4, 4) for pose in (frame.camera_to_global, frame.lateral_camera_to_global)):
                raise ValueError(f"a pose of key frame {frame.sample_index} is no 4x4 matrix")
        return Truth(**content, frames=frames)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(path, RULE, f"not a record of truth ({error})") from error


def truth_image(path: str | Path, name: str) -> Path:
    """The path of image `name` beside the truth.json at `path`. Raises ResultError if it is missing."""
    image = Path(path).parent / name
    if not image.is_file():
        raise ResultError(
            f"{image} is missing; delete {path} and rerun: the rule '{RULE}' makes the world anew, with its truth"
        )
    return image
