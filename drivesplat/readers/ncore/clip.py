"""An NCore clip, opened by NVIDIA's library, which is imported when a clip is opened. What fails in the library is
refused in one sentence."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.ncore.layout import EXTRA, ClipFiles, clip_metadata
from drivesplat.readers.ncore.pose_graph import PoseGraph, constant_edge, moving_edge
from drivesplat.readers.ncore.store_metadata import Metadata

READ_COMPONENTS = ("poses", "intrinsics", "cameras", "lidars", "cuboids")
COMPONENT_VERSION = "v1"
DEFAULT = "default"
"""The instance of a component that is read where there are several."""
MAX_VALUES = 100_000_000
"""Maximum number of values of an array: a sweep has less than a million rays."""


@dataclass(frozen=True)
class Clip:
    """An opened clip: its `name`, the poses, and the library's readers of its other components."""

    name: str
    sequence: str
    metadata: Metadata
    poses: PoseGraph
    intrinsics: Any
    cameras: dict[str, Any]
    lidars: dict[str, Any]
    observations: list[Any]
    """`CuboidTrackObservation`s."""


@contextmanager
def refusing(record: str) -> Iterator[None]:
    """Raises DatasetError naming `record` for whatever its block raises: the library, Zarr and its codecs each fail in
    their own ways, and assert much."""
    try:
        yield
    except DatasetError:
        raise
    except Exception as error:
        reason = " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())[:200]
        raise DatasetError(
            f"{record} cannot be read ({type(error).__name__}: {reason}); copy the clip again"
        ) from error


def open_clip(files: ClipFiles) -> Clip:
    """Opens a clip. Raises DatasetError naming the clip and its component that is missing, damaged or of another
    version."""
    try:
        from ncore.data import v4
    except ImportError as error:
        raise DatasetError(f"NCore clips need nvidia-ncore ({error}): {EXTRA}") from error
    name, metadata = files.name, clip_metadata(files.stores)
    _require_readable(name, metadata)
    with refusing(f"clip {name}"):
        reader = v4.SequenceComponentGroupsReader(list(files.stores))
    with refusing(f"clip {name}: a component"):
        poses = _one(name, "poses", reader.open_component_readers(v4.PosesComponent.Reader))
        intrinsics = _one(name, "intrinsics", reader.open_component_readers(v4.IntrinsicsComponent.Reader))
        cameras = reader.open_component_readers(v4.CameraSensorComponent.Reader)
        lidars = reader.open_component_readers(v4.LidarSensorComponent.Reader)
        cuboids = reader.open_component_readers(v4.CuboidsComponent.Reader)
    observations: list[Any] = []
    if cuboids:
        with refusing(f"clip {name}: its cuboids"):
            observations = list(_one(name, "cuboids", cuboids).get_observations())
    sequence = str(reader.sequence_id)
    return Clip(name, sequence, metadata, _pose_graph(name, poses), intrinsics, cameras, lidars, observations)


def rays_of(clip: Clip, lidar: str, end: int) -> dict[str, np.ndarray]:
    """The n rays of the sweep that ends at `end` (microseconds): `direction` (n, 3), `timestamp_us` (n,), `range` (n,)
    in metres and `intensity` (n,) of the first return, NaN without one, and where known `model_element` (n, 2), row and
    column. Raises DatasetError naming the sweep where it is damaged."""
    reader, record = clip.lidars[lidar], f"sweep {lidar}/{end}"
    with refusing(record):
        found = {key: reader.get_frame_ray_bundle_data(end, key) for key in ("direction", "timestamp_us")}
        if reader.has_frame_ray_bundle_data(end, "model_element"):
            found["model_element"] = reader.get_frame_ray_bundle_data(end, "model_element")
        returns = {
            key: reader.get_frame_ray_bundle_return_data(end, key, return_index=None)
            for key in ("distance_m", "intensity")
        }
    count = found["timestamp_us"].size
    shapes = {"direction": (count, 3), "timestamp_us": (count,), "model_element": (count, 2)}
    distances, intensities = returns.values()
    fits = all(values.shape == shapes[key] and values.dtype.kind in "fiu" for key, values in found.items())
    if not fits or distances.ndim != 2 or distances.shape[1] != count or intensities.shape != distances.shape:
        raise DatasetError(f"{record}: its arrays have different numbers of rays; copy the clip again")
    if not len(distances):
        return found | {"range": np.full(count, np.nan), "intensity": np.full(count, np.nan)}
    first = np.isfinite(distances).argmax(axis=0)[None]
    picked = (np.take_along_axis(values, first, axis=0)[0] for values in (distances, intensities))
    return found | dict(zip(("range", "intensity"), picked, strict=True))


def image_of(clip: Clip, camera: str, end: int) -> tuple[bytes, str] | None:
    """The file of the image that ends at `end` (microseconds) as it was stored, and its format; None where there is
    none. Raises DatasetError naming the image where it is damaged."""
    if f"cameras/{camera}/frames/{end}/image/.zarray" not in clip.metadata:
        return None
    with refusing(f"image {camera}/{end}"):
        data = clip.cameras[camera].get_frame_data(end)
        return bytes(data.get_encoded_image_data()), str(data.get_encoded_image_format()).lower()


def _one(name: str, component: str, readers: dict[str, Any]) -> Any:
    """The instance of a component that is read: the default one, or the only one."""
    if DEFAULT in readers or len(readers) == 1:
        return readers.get(DEFAULT) or next(iter(readers.values()))
    there = f"has the instances {', '.join(readers)} and none called {DEFAULT}" if readers else "is missing"
    raise DatasetError(f"clip {name}: its component {component} {there}; copy the whole clip, or convert it again")


def _pose_graph(name: str, reader: Any) -> PoseGraph:
    edges = []
    record = f"clip {name}: the pose"
    with refusing(f"clip {name}: its poses"):
        for pair, pose in reader.get_static_poses():
            edges.append((_pair(pair, record), constant_edge(pose, f"{record} {pair}")))
        for pair, (poses, times) in reader.get_dynamic_poses():
            edges.append((_pair(pair, record), moving_edge(poses, times, f"{record} {pair}")))
    return PoseGraph(name, edges)


def _pair(pair: Any, record: str) -> tuple[str, str]:
    if not isinstance(pair, tuple) or len(pair) != 2 or not all(isinstance(frame, str) for frame in pair):
        raise DatasetError(f"{record} {str(pair)[:60]!r}: it must name two frames of reference")
    return pair


def _require_readable(name: str, metadata: Metadata) -> None:
    """Raises DatasetError for components of another version, which the library would leave out, and for arrays of
    sizes that no recording has."""
    for key, content in metadata.items():
        component, *inside = key.split("/")
        if component in READ_COMPONENTS and len(inside) == 2 and inside[1] == ".zattrs":
            version = content.get("component_version")
            if version != COMPONENT_VERSION:
                raise DatasetError(
                    f"clip {name}: its component {component}/{inside[0]} is of version {str(version)[:20]!r}, and "
                    f"{COMPONENT_VERSION} is read; convert the clip with NCore 19"
                )
        if key.endswith("/.zarray"):
            for sizes in (content.get("shape"), content.get("chunks")):
                whole = isinstance(sizes, list) and all(type(size) is int and size >= 0 for size in sizes)
                if not whole or math.prod(sizes) > MAX_VALUES:
                    raise DatasetError(f"clip {name}: array {key.removesuffix('/.zarray')} has no possible size")
