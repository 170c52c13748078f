"""The stage `scan_folder`: writes rendered LiDAR scans as files."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.editing.assets.asset import NO_INSERTS, Inserts
from drivesplat.editing.scans import SimulatedScan, scan_render_plan
from drivesplat.errors import ResultError
from drivesplat.io.point_cloud import write_vertices
from drivesplat.io.storage import Provenance, atomic_write, write_json
from drivesplat.lidar.moved_sensor import sensor_poses_of
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scan_record import ScanRecords
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.export import ScanFolderJob, ScanFormat


def write_scan_folder(
    scene: Scene,
    checkpoint: TrainedCheckpoint,
    records: ScanRecords,
    job: ScanFolderJob,
    device_settings: DeviceSettings,
    path: Path,
    source: dict[str, str],
    provenance: Provenance,
    inserts: Inserts = NO_INSERTS,
) -> None:
    """Writes the scans of `records` after the edit of `job` or along its trajectory into the folder of `path`, and last
    `path`, scans.json, which lists them.

    `source` names the `scene`, the `method`, and the `edit` or the `trajectory`; the edit inserts `inserts`.
    Raises what `scan_render_plan` raises;
    DeviceError; ResultError for a model that was trained without LiDAR, where a rendering contains NaN or Inf, or where
    the disk is full.
    """
    what = " ".join(f"{key} {value}" for key, value in source.items())
    model, _ = open_model(checkpoint, device_settings)
    drive = scan_render_plan(scene, model, records.scans, job, what, inserts)
    objects, folder, listed = drive.objects(), path.parent, []
    _remove_scans(folder)
    try:
        with explain_out_of_memory(lambda: len(model)):
            for found in drive.simulated(checkpoint.job.train.scans.beam_spread_rad):
                values = (found.rendered.ranges, found.rendered.drops, found.rendered.intensities)
                if not all(np.isfinite(array).all() for array in values):
                    raise ResultError(
                        f"{what}: a rendered scan contains NaN or Inf; delete checkpoint.npz and train again"
                    )
                listed.append(_written(folder, found, job.formats, [item["id"] for item in objects]))
        steps = None if job.edit is None else job.edit.model_dump(mode="json", exclude_none=True)["steps"]
        offset = None if job.trajectory is None else job.trajectory.model_dump(exclude={"parts"})
        record = {**source, "steps": steps, "offset": offset, "origin": scene.origin.tolist()}
        write_json(path, {**record, "objects": objects, "scans": listed, "provenance": provenance})
    except BaseException:
        _remove_scans(folder)
        raise


def _remove_scans(folder: Path) -> None:
    """Removes the scans of an earlier or a failed run."""
    for kind in _WRITERS:
        for file in folder.glob(f"*/*.{kind}"):
            if file.name.removesuffix(f".{kind}").isdigit():
                file.unlink()


def _written(folder: Path, found: SimulatedScan, formats: Sequence[ScanFormat], objects: list[str]) -> dict[str, Any]:
    """Writes the files of a scan; returns its entry in scans.json."""
    sensor, files = found.sensor, {}
    for kind in formats:
        files[kind] = f"{sensor.lidar}/{sensor.timestamp}.{kind}"
        _WRITERS[kind](folder / files[kind], found, objects)
    return {
        "lidar": sensor.lidar,
        "timestamp": sensor.timestamp,
        "seconds": sensor.seconds,
        "is_key_frame": sensor.is_key_frame,
        "group": sensor.group,
        "sensor_to_world": sensor.sensor_to_world.tolist(),
        "linear": sensor.linear.tolist(),
        "angular": sensor.angular.tolist(),
        "rays": int(sensor.measured.sum()),
        "returns": int(found.returned.sum()),
        "files": files,
    }


def write_rays(path: Path, found: SimulatedScan, _: list[str]) -> None:
    """Writes all rays as .npz."""
    sensor, rays, rendered = found.sensor, found.sensor.scan.rays, found.rendered
    with atomic_write(path) as file:
        np.savez_compressed(
            file,
            azimuths=rays.azimuths,
            elevations=rays.elevations,
            offsets_s=rays.offsets_s,
            ranges=rendered.ranges.astype(np.float32),
            intensities=rendered.intensities.astype(np.float32),
            drops=rendered.drops.astype(np.float32),
            returned=found.returned,
            measured=sensor.measured,
            objects=found.objects,
            timestamp=np.int64(sensor.timestamp),
            seconds=np.float64(sensor.seconds),
            sensor_to_world=sensor.sensor_to_world,
            linear=sensor.linear,
            angular=sensor.angular,
        )


def write_points(path: Path, found: SimulatedScan, objects: list[str]) -> None:
    """Writes the returns in world coordinates as .ply, with the ids of `objects` in its header."""
    rings, _ = np.nonzero(found.returned)
    x, y, z = found.places()[0].T.astype(np.float32)
    columns = {
        "x": x,
        "y": y,
        "z": z,
        "intensity": found.rendered.intensities[found.returned].astype(np.float32),
        "ring": rings.astype(np.uint16),
        "time": found.sensor.scan.rays.offsets_s[found.returned],
        "object": found.objects[found.returned],
    }
    write_vertices(path, columns, {"timestamp": found.sensor.timestamp, "frame": "world", "objects": objects})


def write_nuscenes(path: Path, found: SimulatedScan, _: list[str]) -> None:
    """Writes the returns as nuScenes has them, by the order of their times: x, y, z in the sensor's frame at the
    timestamp, where the motion of the sensor is compensated, intensity from 0 to 255, and ring."""
    rings, _ = np.nonzero(found.returned)
    points = apply(inverse(sensor_poses_of(found.sensor)(np.zeros(1))[0]), found.places()[0])
    intensity = 255.0 * found.rendered.intensities[found.returned].clip(0.0, 1.0)
    columns = np.column_stack([points, intensity.round(), rings]).astype(np.float32)
    order = np.argsort(found.sensor.scan.rays.offsets_s[found.returned], kind="stable")
    with atomic_write(path) as file:
        file.write(columns[order].tobytes())


_WRITERS: dict[ScanFormat, Callable[[Path, SimulatedScan, list[str]], None]] = {
    "npz": write_rays,
    "ply": write_points,
    "pcd.bin": write_nuscenes,
}
