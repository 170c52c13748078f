"""Writes clips of NCore V4 with NVIDIA's library: the tiny drive of nuScenes' tables, and a drive past tiny things
whose camera and LiDAR record while the vehicle turns.

Poses are stored as NCore's converters do: the world begins at the first pose, `world_global` is the dataset's, and
boxes stand in the frame of the LiDAR.
"""

import json
import lzma
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scene import Scene
from helpers.drives import CAMERA, LIDAR_AT, REACH, World, cast, rays_at, seconds_of

NAME = "clip_0001"
READOUT_US, SWEEP_US, POSE_US = 30_000, 100_000, 10_000
LIDAR = rigid(Rotation.from_euler("zyx", [2.1, 0.01, -0.02]).as_matrix(), LIDAR_AT)
ROWS, COLUMNS = 16, 90
PLACE = rigid(Rotation.from_euler("z", 0.7).as_matrix(), np.array([-25_211.25, 42_391.125, -160.5]))
"""The street of a turning drive in `world_global`."""


@dataclass
class Rays:
    """A sweep: `elements` (n, 2) row and column, `distance` (returns, n)."""

    start: int
    end: int
    direction: np.ndarray
    times: np.ndarray
    distance: np.ndarray
    intensity: np.ndarray
    elements: np.ndarray | None = None


@dataclass
class Recording:
    """A clip before it is written. Sensors by name: mount (4, 4), parameters of the model, and frames; images are
    (start, end, file, format). `rig_to_global` at `times`; boxes are (track, label, time, reference frame, its time,
    object to reference frame, size, source)."""

    times: np.ndarray
    rig_to_global: np.ndarray
    cameras: dict[str, tuple[np.ndarray, Any, list[tuple[int, int, bytes, str]]]] = field(default_factory=dict)
    lidars: dict[str, tuple[np.ndarray, Any, list[Rays]]] = field(default_factory=dict)
    boxes: list[tuple[str, str, int, str, int, np.ndarray, Sequence[float], str]] = field(default_factory=list)
    world_global: bool = True
    dtype: str = "float64"


def write_clip(
    folder: Path, recording: Recording, name: str = NAME, store: Literal["itar", "directory"] = "itar",
    manifest: bool = True, separate: bool = False,
) -> Path:  # fmt: skip
    """Writes a clip to `folder`, with a store for each sensor if `separate`; returns the folder."""
    from ncore.data import BBox3, CuboidTrackObservation, LabelSource, v4
    from ncore.impl.common.transformations import HalfClosedInterval
    from upath import UPath

    first, last = int(recording.times[0]), int(recording.times[-1])
    interval = HalfClosedInterval(first, last + 1)
    writer = v4.SequenceComponentGroupsWriter(UPath(folder), name, f"sequence-{name}", interval, {}, store)
    poses = writer.register_component_writer(v4.PosesComponent.Writer, "default")
    to_world = inverse(recording.rig_to_global[0]) if recording.world_global else np.eye(4)
    rig = (to_world @ recording.rig_to_global).astype(recording.dtype)
    poses.store_dynamic_pose("rig", "world", rig, recording.times.astype(np.uint64))
    if recording.world_global:
        poses.store_static_pose("world", "world_global", inverse(to_world))
    intrinsics = writer.register_component_writer(v4.IntrinsicsComponent.Writer, "default")
    for sensor, (mount, model, images) in recording.cameras.items():
        poses.store_static_pose(sensor, "rig", mount.astype(recording.dtype))
        intrinsics.store_camera_intrinsics(sensor, model)
        of_camera = writer.register_component_writer(
            v4.CameraSensorComponent.Writer, sensor, sensor if separate else None
        )
        for start, end, content, kind in images:
            of_camera.store_frame(content, kind, np.array([start, end], dtype=np.uint64), {}, {})
    for sensor, (mount, model, sweeps) in recording.lidars.items():
        poses.store_static_pose(sensor, "rig", mount.astype(recording.dtype))
        if model is not None:
            intrinsics.store_lidar_intrinsics(sensor, model)
        of_lidar = writer.register_component_writer(
            v4.LidarSensorComponent.Writer, sensor, sensor if separate else None
        )
        for rays in sweeps:
            of_lidar.store_frame(
                rays.direction.astype(np.float32), rays.times.astype(np.uint64),
                None if rays.elements is None else rays.elements.astype(np.uint16), rays.distance.astype(np.float32),
                rays.intensity.astype(np.float32), np.array([rays.start, rays.end], dtype=np.uint64), {}, {},
            )  # fmt: skip
    observations = [
        CuboidTrackObservation(
            track, label, time, frame, at,
            BBox3(
                tuple(pose[:3, 3].tolist()), tuple(map(float, size)),
                tuple(Rotation.from_matrix(pose[:3, :3]).as_euler("xyz").tolist()),
            ),
            LabelSource[source],
        )
        for track, label, time, frame, at, pose, size, source in recording.boxes
    ]  # fmt: skip
    writer.register_component_writer(v4.CuboidsComponent.Writer, "default").store_observations(observations)
    paths = writer.finalize()
    if manifest:
        meta = v4.SequenceComponentGroupsReader(paths).get_sequence_meta().to_dict()
        (folder / f"{name}.json").write_text(json.dumps(meta))
    return folder


def pinhole(k: np.ndarray, size: tuple[int, int], shutter: str = "ROLLING_TOP_TO_BOTTOM", **changes: Any) -> Any:
    """OpenCV's pinhole model with the K of a scene, and the coefficients of `changes`."""
    from ncore.data import OpenCVPinholeCameraModelParameters, ShutterType

    zeros = {"radial_coeffs": [0.0] * 6, "tangential_coeffs": [0.0] * 2, "thin_prism_coeffs": [0.0] * 4}
    return OpenCVPinholeCameraModelParameters(
        resolution=np.array(size, dtype=np.uint64), shutter_type=ShutterType[shutter],
        external_distortion_parameters=None, principal_point=(k[:2, 2] + 0.5).astype(np.float32),
        focal_length=k.diagonal()[:2].astype(np.float32),
        **{name: np.array(changes.get(name, none), dtype=np.float32) for name, none in zeros.items()},
    )  # fmt: skip


def spinning_model(rows: int = ROWS, columns: int = COLUMNS) -> Any:
    """A LiDAR that goes round clockwise from straight behind, with shifted rows."""
    from ncore.data import RowOffsetStructuredSpinningLidarModelParameters

    return RowOffsetStructuredSpinningLidarModelParameters(
        10.0, "cw", rows, columns, np.linspace(0.15, -0.4, rows, dtype=np.float32),
        np.linspace(np.pi, -np.pi, columns, endpoint=False, dtype=np.float32),
        np.where(np.arange(rows) % 2, 0.01, -0.01).astype(np.float32),
    )  # fmt: skip


def tables_recording(scene: Scene, readout_us: int = READOUT_US) -> Recording:
    """The scene of nuScenes' tables as a clip: an image lasts `readout_us` about its time, sweeps are at one time."""
    ends = [recording.timestamp for recording in (*scene.frames, *scene.sweeps)]
    times = np.arange(min(ends) - 50_000, max(ends) + 50_001, POSE_US, dtype=np.int64)
    half = readout_us // 2
    times = np.unique([*times, *ends, *(time - half for time in ends), *(time + half for time in ends)])
    known = {frame.timestamp: frame.ego_to_world for frame in scene.frames}
    stamps = np.array(sorted(known))
    places = np.stack([known[int(stamp)][:3, 3] + scene.origin for stamp in stamps])
    slope = (places[-1] - places[0]) / (stamps[-1] - stamps[0])  # the tiny vehicle drives straight on
    rig = rigid(known[int(stamps[0])][:3, :3], places[0] + (times - stamps[0])[:, None] * slope)
    frame, camera = scene.frames[0], scene.cameras[0]
    images = [
        (one.timestamp - half, one.timestamp + half, Path(one.image_path).read_bytes(), "jpeg") for one in scene.frames
    ]
    recording = Recording(times, rig)
    model = pinhole(camera.intrinsics, (camera.width, camera.height))
    recording.cameras["front"] = frame.camera_to_ego, model, images
    mount = rigid(np.eye(3), LIDAR_AT)
    recording.lidars["top"] = mount, None, [_still(sweep) for sweep in scene.sweeps]
    for track in scene.tracks:
        for time, pose in zip(track.timestamps.tolist(), track.object_to_world, strict=True):
            in_global = rigid(pose[:3, :3], pose[:3, 3] + scene.origin)
            to_lidar = inverse(rig[int(np.searchsorted(times, time))] @ mount)
            recording.boxes.append(
                (track.id, track.category, time, "top", time, to_lidar @ in_global, track.size.tolist(), "AUTOLABEL")
            )
    return recording


def _still(sweep: Any) -> Rays:
    """The returns of a sweep as rays that leave at its timestamp."""
    returns = read_returns(sweep)
    distance = np.linalg.norm(returns.points, axis=1)
    times = np.full(len(distance), sweep.timestamp)
    return Rays(
        sweep.timestamp, sweep.timestamp, returns.points / distance[:, None], times, distance[None],
        returns.intensity[None],
    )  # fmt: skip


def write_metadata(path: Path, metadata: dict[str, Any]) -> None:
    """Writes the consolidated metadata of a store that is a folder."""
    import cbor2

    path.write_bytes(lzma.compress(cbor2.dumps({"zarr_consolidated_format": 1, "metadata": metadata}), preset=0))


def turning_recording(
    world: World, start: int, sweeps: int = 5, rays: tuple[int, int] = (ROWS, COLUMNS)
) -> tuple[Recording, dict[int, np.ndarray]]:
    """A drive that turns, recorded by a rolling camera and a spinning LiDAR that sees the world as it is at the time of
    each column, and where its rays end (rows, columns, 3), by the ends of sweeps."""
    times = np.arange(start, start + sweeps * SWEEP_US + 1, POSE_US, dtype=np.int64)
    recording = Recording(times, np.stack([world.ego(time) for time in times]))
    model = spinning_model(*rays)
    found, hits = [], {}
    for number in range(sweeps):
        begin = start + number * SWEEP_US
        sweep, ends = _spun(world, begin, begin + SWEEP_US - 1, model)
        found.append(sweep)
        hits[sweep.end] = ends
        middle = (sweep.start + sweep.end) // 2
        for thing in world.things:
            met = middle + 7_000  # the time at which the sensor met it
            sensor = world.ego(begin + SWEEP_US - 1) @ LIDAR
            box = inverse(sensor) @ world.box(thing, met)
            recording.boxes.append(
                (thing.category, thing.category, met, "lidar", sweep.end, box, thing.size, "EXTERNAL")
            )
    recording.lidars["lidar"] = LIDAR, model, found
    png = BytesIO()
    Image.new("RGB", (world.width, world.height), (90, 120, 60)).save(png, "PNG")
    images = [(t, t + READOUT_US, png.getvalue(), "png") for t in range(start, int(times[-1]) - READOUT_US, 50_000)]
    recording.cameras["front"] = CAMERA, pinhole(world.intrinsics, (world.width, world.height)), images
    return recording, hits


def _spun(world: World, start: int, end: int, model: Any) -> tuple[Rays, np.ndarray]:
    rows, columns = model.n_rows, model.n_columns
    hits = np.full((rows, columns, 3), np.nan)
    direction, distance = np.zeros((rows, columns, 3)), np.full((rows, columns), np.nan)
    stamps = np.round(start + (end - start) * np.arange(columns) / (columns - 1)).astype(np.int64)
    for column, time in enumerate(stamps.tolist()):
        azimuths = model.column_azimuths_rad[column] + model.row_azimuth_offsets_rad.astype(np.float64)
        direction[:, column] = rays_at(azimuths, model.row_elevations_rad.astype(np.float64))
        sensor = world.ego_pose(seconds_of(time)) @ LIDAR
        turned = direction[:, column].astype(np.float32).astype(np.float64) @ sensor[:3, :3].T
        found, _ = cast(world, sensor[:3, 3], turned, seconds_of(time))
        hit = found < REACH
        distance[hit, column] = found[hit]
        hits[hit, column] = apply(world.place, sensor[:3, 3] + turned[hit] * found[hit, None])
    elements = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2)
    values = distance.reshape(1, -1)
    return Rays(
        start, end, direction.reshape(-1, 3), np.tile(stamps, rows), values, np.where(np.isnan(values), np.nan, 0.25),
        elements,
    ), hits  # fmt: skip
