"""One drive in five formats: nuScenes tables, a drive folder, Waymo v2, a clip of NCore and an imported bag (MCAP).

The LiDAR of all has the rays of a Waymo laser, whose directions are fixed by its format: the tables hold where these
end. The street has no turn, so that the global frames of all formats have the same axes.
"""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drivesplat.export.drive_mcap import write_mcap
from drivesplat.preprocess.extract import extract_scene
from drivesplat.readers.drive.bag.bag_import import import_bag, propose
from drivesplat.readers.drive.write import write_drive
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import Track
from drivesplat.settings.extract import SceneSource
from helpers import drives
from helpers.drives import LIDAR_AT, World
from helpers.ncore_clips import NAME as CLIP
from helpers.ncore_clips import tables_recording, write_clip
from helpers.waymo_drive import NAME as SEGMENT
from helpers.waymo_drive import tables_scan, tiny_drive
from helpers.waymo_files import write_v2

INTENSITY = 64.0


class FormatDrive(NamedTuple):
    """The drive in one format: the `root` of its dataset, and what `extract` reads there."""

    root: Path
    source: SceneSource

    def extracted(self, results: Path) -> Scene:
        with drives.uncompared():
            return extract_scene(self.source, self.root, None, results)


def write_formats(folder: Path, world: World) -> dict[str, FormatDrive]:
    """Writes the drive of a `world` whose recordings are all at key frames in each format; by the name of the format,
    `tables` first."""
    tables = drives.write_world(folder / "tables", world)
    scene = drives.scene_at(tables, lidar_sweeps=True)
    place = rigid(np.eye(3), scene.origin)
    recorded, _ = tiny_drive(tables, world, scan=tables_scan(), place=place)
    for sweep, rays in zip(scene.sweeps, recorded.sweeps, strict=True):
        assert sweep.timestamp == rays.frame
        there = np.isfinite(rays.hits[..., 0])
        rows = np.broadcast_to(np.arange(len(there))[:, None], there.shape)[there]
        to_sensor = inverse(recorded.frames[rays.frame] @ rigid(np.eye(3), LIDAR_AT))
        points = apply(to_sensor, rays.hits[there])
        columns = [*points.T, np.full(len(points), INTENSITY), rows]
        np.column_stack(columns).astype(np.float32).tofile(sweep.path)
    write_drive(scene, folder / "drive" / "same")
    write_v2(folder / "waymo", recorded)
    write_clip(folder / "ncore", tables_recording(scene, readout_us=0))
    write_mcap(folder / "drive" / "same", folder / "same.mcap")
    text, _ = propose(folder / "same.mcap")
    (folder / "topics.yaml").write_text(text)
    import_bag(folder / "same.mcap", folder / "topics.yaml", folder / "bag" / "same")
    found = {
        "tables": (tables, "nuscenes", world.version, "0001", "CAM_FRONT"),
        "drive": (folder / "drive", "drive", "", "same", "CAM_FRONT"),
        "waymo": (folder / "waymo", "waymo", "v2", SEGMENT, "FRONT"),
        "ncore": (folder / "ncore", "ncore", "", CLIP, "front"),
        "bag": (folder / "bag", "drive", "", "same", "CAM_FRONT"),
    }
    return {
        name: FormatDrive(
            root,
            drives.source(
                dataset=name, reader=reader, version=version, scene=one, cameras=(camera,), lidar_sweeps=True
            ),
        )
        for name, (root, reader, version, one, camera) in found.items()
    }  # fmt: skip


def with_tracks_of(scene: Scene, other: Scene) -> Scene:
    """A scene with the tracks of another one, which differs in the origin of its world and in times of key frames."""
    shift = first_place(scene) - first_place(other)

    def moved(track: Track) -> Track:
        poses = np.stack([rigid(pose[:3, :3], pose[:3, 3] + shift) for pose in track.object_to_world])
        return dataclasses.replace(track, object_to_world=poses)

    return dataclasses.replace(scene, tracks=tuple(map(moved, other.tracks)))


def first_place(scene: Scene) -> np.ndarray:
    """The position of the vehicle in the world at the first image."""
    return min(scene.frames, key=lambda frame: frame.timestamp).ego_to_world[:3, 3]
