"""A `TrainedDrive` of a model made by hand, without any result folder."""

import dataclasses
from pathlib import Path

import numpy as np
import torch

from drivesplat.drive.recorded_drive import RecordedDrive
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.io.array_file import write_arrays
from drivesplat.io.storage import no_provenance
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.ego_mask import NO_EGO_MASK
from drivesplat.scene.scan_record import ScanRecords
from drivesplat.scene.scene import Scene
from helpers.records import training_record_of

K = np.array([[40.0, 0.0, 32.0], [0.0, 40.0, 24.0], [0.0, 0.0, 1.0]])
"""Of images of 64x48 pixels."""
BEAM_SPREAD = (3e-4, 3e-4)


def drive_of(scene: Scene, model: SplatModel, folder: Path, scans: ScanRecords | None = None) -> TrainedDrive:
    """The drive of a scene and a model on the CPU, with images of 64x48 pixels, and perhaps recorded scans."""
    record = training_record_of(len(scene.frames), Ks=np.tile(K, (len(scene.frames), 1, 1)))
    file = folder / "scans.npz"
    if scans is not None:
        write_arrays(file, dataclasses.asdict(scans))
    recording = RecordedDrive("a test", scene, record, NO_EGO_MASK, file)
    return TrainedDrive(folder / "street", recording, model, torch.device("cpu"), BEAM_SPREAD, no_provenance())
