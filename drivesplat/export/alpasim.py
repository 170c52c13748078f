"""The stage `export_alpasim`: a trained drive as scene.alpasim.usdz, a scene that AlpaSim loads, and that
`drivesplat.open` opens without the dataset and the folder of results.

Its members, in this order:

- metadata.yaml, rig_trajectories.json, sequence_tracks.json, data_info.json: `drivesplat.export.alpasim_records`
- mesh_ground.ply: the ground about the path, for physics; mesh.ply: the static world, coarse
- drivesplat/: the trained drive (`drivesplat.drive.packed_drive`)

It has no OpenUSD layer: AlpaSim takes it for a ZIP archive. scene.usdz is the file for programs with OpenUSD.
"""

import json
import logging
import uuid
from pathlib import Path

import yaml

from drivesplat.drive.packed_drive import packed_members
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError
from drivesplat.export.alpasim_records import AlpasimScene, data_info, metadata, rig_trajectories, sequence_tracks
from drivesplat.export.drive_mesh import drive_mesh
from drivesplat.export.ground_mesh import ground_surface, surface_mesh
from drivesplat.io.aligned_zip import write_aligned_zip
from drivesplat.io.storage import Provenance, canonical_json, sha256_file
from drivesplat.io.triangle_mesh import ply_bytes
from drivesplat.model.checkpoint import CHECKPOINT
from drivesplat.settings.export import AlpasimJob

log = logging.getLogger(__name__)

NAMESPACE = uuid.uuid5(uuid.NAMESPACE_DNS, "drivesplat")
"""Of the UUIDs of scenes."""


def export_alpasim(path: str | Path, drive: TrainedDrive, job: AlpasimJob, provenance: Provenance) -> None:
    """Writes the scene of a finished training. Equal inputs give equal bytes.

    Raises RequestError for a drive without cameras, an edited one, or one whose training has not finished, ResultError
    naming the file if it cannot be written.
    """
    if not drive.cameras or drive.edit is not None:
        raise RequestError(f"{drive.where}: a scene for AlpaSim is that of a drive with cameras, as recorded")
    own = scene_id(drive)
    scene = AlpasimScene.of(drive, own)
    ground = ground_surface(scene.ego_to_world, drive.record.points[: drive.record.seed.lidar])
    meshes = {"mesh_ground.ply": surface_mesh(ground), "mesh.ply": drive_mesh(drive, ground)}
    tracks = sequence_tracks(scene)
    records = {
        "rig_trajectories.json": rig_trajectories(scene, job.body),
        "sequence_tracks.json": tracks,
        "data_info.json": data_info(scene),
    }
    content: dict[str, bytes | Path] = {
        "metadata.yaml": yaml.safe_dump(metadata(scene, own, provenance), sort_keys=True).encode(),
        **{
            name: json.dumps(record, sort_keys=True, allow_nan=False).encode() + b"\n"
            for name, record in records.items()
        },
        **{name: ply_bytes(mesh) for name, mesh in meshes.items()},
        **packed_members(drive.folder, drive.scene.name, drive_files(drive)),
    }
    write_aligned_zip(path, content)
    triangles = ", ".join(f"{len(mesh)} triangles in {name}" for name, mesh in meshes.items())
    (sequence,) = tracks.values()
    log.info("%s: %d tracks, %s", own, len(sequence["tracks_data"]["tracks_id"]), triangles)


def scene_id(drive: TrainedDrive) -> str:
    """The id of a drive in AlpaSim, `clipgt-` and a UUID, as its lists of scenes want them.

    The UUID is a digest of dataset, scene, method and checkpoint. So it stays when the scene is exported again, is the
    same for the folder of results and for the archive, and differs for another training: AlpaSim refuses two files
    with one id. Raises RequestError where the training has not finished.
    """
    folder = drive.folder.absolute()
    checkpoint = folder / CHECKPOINT
    if not checkpoint.is_file():
        raise RequestError(f"{drive.where}: the training has not finished: {checkpoint} is missing")
    named = [drive.scene.dataset, drive.scene.name, folder.name, sha256_file(checkpoint)]
    return f"clipgt-{uuid.uuid5(NAMESPACE, canonical_json(named))}"


def drive_files(drive: TrainedDrive) -> list[Path]:
    """The files that `drivesplat.open` reads; the scans of LiDARs where the drive renders them."""
    recording = drive.recording
    scans = [recording.scans_file] if drive.renders_lidar and recording.scans_file.is_file() else []
    return [drive.folder / CHECKPOINT, *recording.files, *scans]
