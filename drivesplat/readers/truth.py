"""Ground truth of a synthetic world: images, depth, instances and classes from the recorded path and from beside it, of
the drive as it was and of edited drives; LiDAR scans ray by ray.

`truth/truth.json` below a dataset's root lists the files. Images are lossless and free of sensor noise.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int16, UInt16

from drivesplat.errors import ResultError
from drivesplat.io.storage import read_json, unreadable, write_json

SCHEMA = 2
TRUTH_FILE = "truth/truth.json"
"""Below a dataset's root."""
RULE = "demo_world"
DEPTH_UNITS_PER_METRE = 256.0
DEPTH_LIMIT = 65535
"""The largest value of a 16-bit depth image; farther depths are clipped to it."""


@dataclass(frozen=True)
class TruthFrame:
    """The truth of one key frame in one view: the token of the recorded image's sample_data (of a held-out camera: that
    it would have), its index, the camera pose (4, 4) in the dataset's global frame, and file names.

    `image` is None where it is the recorded one. `depth`: 16 bits, units of 1/256 metre along the optical axis up to
    256 m, 0 for the sky (KITTI's convention). `instances`: 8 bits, a key of `Truth.instances`, 0 for scenery.
    `classes`: 8 bits, a key of `Truth.classes`.
    """

    token: str
    key_frame: int
    camera_to_global: list[list[float]]
    image: str | None
    depth: str
    instances: str
    classes: str


@dataclass(frozen=True)
class TruthView:
    """The key frames of `camera` seen from `left_m` metres to the left of its recorded path, of the drive as it was or
    after the edit of that name, without the instance `without` if given."""

    camera: str
    left_m: float
    edit: str | None
    without: str | None
    frames: tuple[TruthFrame, ...]

    @property
    def is_recorded(self) -> bool:
        """Whether it shows the drive as it was, from its own path."""
        return not self.left_m and self.edit is None and self.without is None

    def by_image(self) -> dict[str, TruthFrame]:
        """The frames by the token of their image's sample_data."""
        return {frame.token: frame for frame in self.frames}


@dataclass(frozen=True)
class TruthScan:
    """A LiDAR scan: the token of its sample_data, its key frame, the sensor's pose (4, 4) at its timestamp in the
    dataset's global frame, offset, edit and the instance that it is `without` as of a view, and the name of an .npz
    file. Its arrays (beams, steps), one entry per ray of the pattern: `range`
    without noise in metres (float32, infinite without a hit), `intensity` in [0, 1], `instance` as in instance images,
    `returned`."""

    token: str
    key_frame: int
    sensor_to_global: list[list[float]]
    left_m: float
    edit: str | None
    without: str | None
    file: str


@dataclass(frozen=True)
class Truth:
    """The content of truth.json. `leading`: the instance of the vehicle ahead, None without one; `instances`: token by
    number in the instance images; `classes`: name by number in the class images; `pattern`: the name of an .npz file
    with `elevations` (beams,), `azimuths` (steps,) in radians and `offsets` (steps,), seconds of each ray after its
    sweep's timestamp; None without scans."""

    scene: str
    width: int
    height: int
    samples_per_pixel: int
    leading: str | None
    instances: dict[str, str]
    classes: dict[str, str]
    views: tuple[TruthView, ...]
    pattern: str | None
    scans: tuple[TruthScan, ...]

    def recorded(self, camera: str) -> TruthView | None:
        """The view of a camera from its own path."""
        return next((view for view in self._of(camera) if view.is_recorded), None)

    def lateral(self, camera: str) -> list[TruthView]:
        """The views of a camera from beside its path."""
        return [view for view in self._of(camera) if view.left_m]

    def without_leading(self, camera: str) -> TruthView | None:
        """The view of a camera without the vehicle ahead."""
        return next((view for view in self._of(camera) if view.without is not None), None)

    def edited(self, camera: str, edit: str) -> list[TruthView]:
        """The views of a camera after an edit."""
        return [view for view in self.views if view.camera == camera and view.edit == edit]

    def scans_of(
        self, left_m: float = 0.0, without: str | None = None, edit: str | None = None
    ) -> dict[str, TruthScan]:
        """The scans of the drive as it was or after an edit, from so far to the left and without that instance, by the
        token of their sample_data."""
        wanted = (scan for scan in self.scans if scan.edit == edit and scan.without == without)
        return {scan.token: scan for scan in wanted if scan.left_m == left_m}

    @property
    def left_of_scans(self) -> list[float]:
        """How far to the left of the recorded path (metres) there are scans of the drive as it was."""
        return list(dict.fromkeys(scan.left_m for scan in self.scans if scan.left_m and scan.edit is None))

    def _of(self, camera: str) -> Iterator[TruthView]:
        return (view for view in self.views if view.camera == camera and view.edit is None)


def write_truth_file(root: Path, truth: Truth) -> None:
    """Writes truth.json below a dataset's `root`."""
    write_json(root / TRUTH_FILE, {"schema": SCHEMA, **asdict(truth)})


def read_truth(path: str | Path) -> Truth:
    """Reads truth.json. Raises ResultError that names the file and its rule if it is invalid."""
    content = read_json(path, RULE)
    try:
        if content.pop("schema") != SCHEMA:
            raise ValueError("it has another schema")
        views = tuple(_view(view) for view in content.pop("views"))
        scans = tuple(TruthScan(**scan) for scan in content.pop("scans"))
        return Truth(**content, views=views, scans=scans)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(path, RULE, f"not a record of truth ({error})") from error


def _view(content: dict) -> TruthView:
    frames = tuple(TruthFrame(**frame) for frame in content.pop("frames"))
    for frame in frames:
        if np.shape(frame.camera_to_global) != (4, 4):
            raise ValueError(f"the pose of key frame {frame.key_frame} is no 4x4 matrix")
    view = TruthView(**content, frames=frames)
    if not view.is_recorded and any(frame.image is None for frame in frames):
        raise ValueError(f"a view of {view.camera} that was not recorded has no image")
    return view


def truth_image(path: str | Path, name: str) -> Path:
    """The path of image `name` beside the truth.json at `path`. Raises ResultError if it is missing."""
    image = Path(path).parent / name
    if not image.is_file():
        raise ResultError(
            f"{image} is missing; delete {path} and rerun: the rule '{RULE}' makes the world anew, with its truth"
        )
    return image


def truth_arrays(path: str | Path, name: str, *arrays: str) -> list[np.ndarray]:
    """Arrays of the .npz file `name` beside the truth.json at `path`. Raises ResultError naming it where it is missing
    or does not hold them."""
    file = truth_image(path, name)
    try:
        with np.load(file, allow_pickle=False) as held:
            return [held[array] for array in arrays]
    except Exception as error:  # zip and numpy each fail in their own ways
        raise unreadable(file, RULE, f"not an archive of {', '.join(arrays)} ({error})", delete=path) from error


def depth_units(depth: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """Depths in metres in units of 1/256 m, 0 where there is none, as images of depth contain them."""
    return np.clip(depth * DEPTH_UNITS_PER_METRE + 0.5, 0, DEPTH_LIMIT).astype(np.uint16)


def numbered(indices: Int16[np.ndarray, "h w"], numbers: list[int]) -> UInt16[np.ndarray, "h w"]:
    """The number of each index, 0 for -1, as images of objects contain them."""
    return np.array([*numbers, 0], dtype=np.uint16)[indices]  # the last is what -1 finds
