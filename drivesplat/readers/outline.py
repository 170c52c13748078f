"""The outline of a recording: what it holds, as far as that is known before it is read, and what it is unfit for."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from drivesplat.settings.images import NEIGHBOURHOOD_HZ, HoldoutSettings, ImageSettings

BYTES_PER_PIXEL = 3


@dataclass(frozen=True)
class RecordedCamera:
    """The size in pixels of a camera's images, and how many of them there are."""

    width: int
    height: int
    images: int


@dataclass(frozen=True)
class Outline:
    """The cameras of a recording by name, the times of its key frames (microseconds), the number of its LiDAR sweeps,
    and the LiDARs whose beams are unknown, and thereby their rays."""

    cameras: Mapping[str, RecordedCamera]
    key_frames: Sequence[int]
    sweeps: int
    without_beams: Sequence[str] = ()

    def image_bytes(self, cameras: Sequence[str], images: ImageSettings, between: bool) -> int:
        """Bytes of the images of some `cameras` at the size of the settings, as trainings keep them: of those at key
        frames, and with `between` of the others, too."""
        total = 0
        for camera in (self.cameras[name] for name in cameras if name in self.cameras):
            width = images.width or camera.width
            height = round(camera.height * width / camera.width)
            count = camera.images if between else min(camera.images, len(self.key_frames))
            total += BYTES_PER_PIXEL * width * height * count
        return total


def unknown_camera(scene: str, known: Collection[str], cameras: Sequence[str]) -> str | None:
    """A sentence about the first of `cameras` that is not `known` of a recording; None where all are."""
    absent = [name for name in cameras if name not in known]
    there = ", ".join(known) or "none"
    return f"scene {scene}: the drive has no camera {absent[0]!r}; there are: {there}" if absent else None


def frames_beyond(scene: str, count: int, frames: Sequence[int] | None) -> str | None:
    """A sentence about a range of key frames [first, last + 1) that ends beyond the last of `count`."""
    if not frames or frames[1] <= count:
        return None
    return f"scene {scene}: the frame range {tuple(frames)} ends beyond its {count} key frames"


def without_lidar(scene: str) -> str:
    """A sentence about a scene without LiDAR whose seed is to come from LiDAR."""
    return f"scene {scene} has no LiDAR sweeps; set lidar_seed.on_missing: warn to seed from images alone"


def without_training(scene: str, key_frames: int) -> str:
    """A sentence about a scene of which no image is left for training."""
    return (
        f"scene {scene}: the hold-out leaves none of its {key_frames} key frames to train on; "
        "lower holdout.last_block or holdout.neighbourhood_s, or set holdout.every_nth: 0"
    )


def without_scans(scene: str) -> str:
    """A sentence about a scene that gives no LiDAR scan."""
    return (
        f"scene {scene} has no LiDAR sweep that gives a scan; leave out methods that render LiDAR, and give "
        "those with tracks: discovered other tracks (annotated or none, docs/without_boxes.md)"
    )


def unknown_beams(lidar: str) -> str:
    """A sentence about a LiDAR whose rays are unknown."""
    return (
        f"LiDAR {lidar}: its returns have no rings and its beam_elevations are unknown, and methods that render LiDAR "
        "need its rows and columns; give one of them. A LiDAR without beams, as many solid-state ones, has neither: "
        "leave these methods and discovered tracks out (docs/lidar.md); all else works"
    )


def trained_key_frames(times: Sequence[int], holdout: HoldoutSettings) -> list[int]:
    """The indices of the key frames at `times` (microseconds) that are neither held out nor, at NEIGHBOURHOOD_HZ and
    more, nearer to one that is than `holdout.neighbourhood_s`, whichever image is nearest to their time."""
    held_out = {index for group in holdout.held_out(len(times)).values() for index in group}
    intervals = sorted(after - before for before, after in pairwise(times))
    dense = bool(intervals) and intervals[len(intervals) // 2] * NEIGHBOURHOOD_HZ <= 1e6
    near = (holdout.neighbourhood_s * 1e6 - intervals[0] / 2.0) if dense else 0.0
    return [
        index
        for index, time in enumerate(times)
        if index not in held_out and all(abs(time - times[other]) >= near for other in held_out)
    ]
